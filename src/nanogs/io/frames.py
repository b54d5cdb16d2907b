"""The frame that a file states of its axes, and what of it comes into a file that is made of it.

A model does not know its frame. Where it is not turned, a file that can state the frame repeats
what the input states; of another one, a sentence says that it does not.
"""

from collections.abc import Sequence
from pathlib import Path

from nanogs.io import registry
from nanogs.io.format import FormatOptions
from nanogs.io.parts import FileSource


def repeated(
    path: Path, options: FormatOptions | None, inputs: Sequence[FileSource]
) -> tuple[FormatOptions | None, tuple[str, ...]]:
    """Options with which a file states the frame that its inputs state, and what is to be said.

    Args:
        path: What is to be written of a model that is not turned.
        options: Of its format, as they were given.
        inputs: The files that the model is in.

    Raises:
        FormatError: What states a frame cannot be read.
    """
    known, given = registry.find(path), options or {}
    stated = {each.frame for each in inputs}
    if known is None or len(stated) != 1 or stated == {""} or given.get("frame"):
        return options, ()
    [frame] = stated
    options_with = {**given, "frame": frame}
    if known.states_frame(options_with) and frame in known.options["frame"].values:
        return options_with, ()
    if known.axes == frame:
        return options, ()
    if known.axes is None:
        what = f"the output does not, which such a {known.suffix} file has no place for"
    else:
        what = f"it was written as if they were {known.axes}, as of {known.suffix} files"
    return options, (f"The input states that its axes are {frame}, and {what}; it was not turned.",)
