"""The errors that nanogs raises for its users: one sentence each, with the remedy.

Everything a user can cause derives from `NanogsError`; the command line turns it into exit code 2.
Anything else that escapes is a defect of ours.
"""


class NanogsError(Exception):
    """Base of every error caused by what the user gave; the message names place and remedy."""


class FormatError(NanogsError):
    """A file is not what its name says, is damaged, or holds something that cannot be kept."""


class ModelError(NanogsError):
    """A model's arrays disagree with each other or hold no usable splat."""


class OptionError(NanogsError):
    """An option or a combination of options makes no sense for this input."""


class OutputError(NanogsError):
    """The output cannot be written: it exists, its folder is missing, or the disk is full."""
