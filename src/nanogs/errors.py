"""The exceptions that nanogs raises; each message is one sentence that ends with the remedy.

Every error that a user can cause derives from `NanogsError`; the command line turns it into exit
code 2. Any other exception that escapes is a defect of nanogs.
"""

import difflib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager


class NanogsError(Exception):
    """Base class of every error caused by user input; the message names the place and a remedy."""


class FormatError(NanogsError):
    """A file does not match its suffix, is damaged, or holds data that nanogs cannot keep."""


class NoViewsError(FormatError):
    """A data set has no views of a split, or a file of cameras lists none."""


class ModelError(NanogsError):
    """A model's arrays are inconsistent or hold no usable splat."""


NONE_USABLE = "No splat is usable: every one holds a NaN or an infinite value."


class OptionError(NanogsError):
    """An option or a combination of options is invalid for this input."""


class RangeError(OptionError):
    """A parameter is out of range.

    Args:
        name: The parameter.
        option: Name of the command's option, in which "_" stands for "-".
        wrong: The rest of the message, such as "must be 1 or more, not 0".
    """

    def __init__(self, name: str, option: str, wrong: str) -> None:
        super().__init__(name, option, wrong)

    def __str__(self) -> str:
        name, _, wrong = self.args
        return f"{name} {wrong}."

    @property
    def for_command(self) -> str:
        """The message with the option in place of the parameter."""
        _, option, wrong = self.args
        return f"--{option.replace('_', '-')} {wrong}."


class TooManyError(OptionError):
    """More splats are asked for than the model has usable ones."""


class TooSmallError(OptionError):
    """No result of this model is as small as the file size or the draw cost that was asked for."""


class CrowdedError(OptionError):
    """More splats than a block may hold share one place, so that they cannot be divided."""


class ManyChildrenError(OptionError):
    """A splat of a level would stand for more of the next finer level than a format can state."""


class SmallViewError(OptionError):
    """A view is too small to choose results by."""


class OutputError(NanogsError):
    """The output cannot be written: it exists, its folder is missing, or the disk is full."""


class UnstorableError(OutputError):
    """A format cannot encode a value of this model, or cannot hold this number of splats."""


class ExistsError(OutputError):
    """The output exists, and replacing it was not allowed.

    Python and the command allow it in different ways, so the message is completed only when it is
    shown.

    Args:
        fact: The problem, without a full stop, such as "a.ply exists already".
        deed: The action that the caller may allow, such as "replace it".
    """

    def __init__(self, fact: str, deed: str = "replace it") -> None:
        super().__init__(fact, deed)

    def __str__(self) -> str:
        return self.sentence("pass overwrite=True")

    def sentence(self, remedy: str) -> str:
        """Return the message with a remedy that allows the action, such as "add -w"."""
        fact, deed = self.args
        return f"{fact}; {remedy} to {deed}."


class NotEnoughMemoryError(NanogsError):
    """The work takes more memory than is free or was allowed."""


@contextmanager
def shown_as(names: Mapping[str, str]) -> Iterator[None]:
    """Replace texts in the message of an error that the block raises, such as temporary paths.

    Args:
        names: What to show in place of each text; the block may add to it.
    """
    try:
        yield
    except NanogsError as error:
        parts = [str(part) for part in error.args]
        for text, name in names.items():
            parts = [part.replace(text, name) for part in parts]
        error.args = tuple(parts)
        raise


def did_you_mean(word: str, choices: Iterable[str], cutoff: float = 0.6) -> str:
    """Return ` (did you mean 'x'?)` for the choice most similar to a word; empty if none is.

    Args:
        word: The word that was given, after which the text is put.
        choices: The known words.
        cutoff: Least similarity, 0 to 1.
    """
    known = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(word.lower(), known, n=1, cutoff=cutoff)
    return f" (did you mean {known[close[0]]!r}?)" if close else ""
