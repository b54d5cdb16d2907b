"""The errors that nanogs raises for its users: one sentence each, with the remedy.

Everything a user can cause derives from `NanogsError`; the command line turns it into exit code 2.
Anything else that escapes is a defect of ours.
"""

import difflib
from collections.abc import Iterable


class NanogsError(Exception):
    """Base of every error caused by what the user gave; the message names place and remedy."""


class FormatError(NanogsError):
    """A file is not what its name says, is damaged, or holds something that cannot be kept."""


class ModelError(NanogsError):
    """A model's arrays disagree with each other or hold no usable splat."""


NONE_USABLE = "No splat is usable: every one holds a NaN or an infinite value."


class OptionError(NanogsError):
    """An option or a combination of options makes no sense for this input."""


class TooSmallError(OptionError):
    """No result of this model fits into the size that was asked for."""


class CrowdedError(OptionError):
    """More splats than a block may have lie in one place."""


class OutputError(NanogsError):
    """The output cannot be written: it exists, its folder is missing, or the disk is full."""


class UnstorableError(OutputError):
    """A format has no code for a value of this model, or not enough room for its splats."""


class ExistsError(OutputError):
    """The output exists, and nobody has said that it may be replaced.

    Python and the command allow it in different words, so the sentence is put together late.

    Args:
        fact: What is the case, without a full stop: "a.ply exists already".
        deed: What may be allowed.
    """

    def __init__(self, fact: str, deed: str = "replace it") -> None:
        super().__init__(fact, deed)

    def __str__(self) -> str:
        return self.sentence("pass overwrite=True")

    def sentence(self, remedy: str) -> str:
        """The message with what allows it, such as "add -w"."""
        fact, deed = self.args
        return f"{fact}; {remedy} to {deed}."


class NotEnoughMemoryError(NanogsError):
    """The memory that is free, or was allowed, is less than this takes."""


def did_you_mean(word: str, choices: Iterable[str], cutoff: float = 0.6) -> str:
    """` (did you mean 'x'?)` for the choice most like a word, to follow it; empty without one.

    Args:
        word: What was given.
        choices: What there is.
        cutoff: How alike they must be, 0 to 1.
    """
    known = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(word.lower(), known, n=1, cutoff=cutoff)
    return f" (did you mean {known[close[0]]!r}?)" if close else ""
