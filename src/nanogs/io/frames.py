"""Carrying the coordinate frame that an input file states over to the output file.

A model does not know its frame. If it is not turned, an output that can state a frame states that
of the input; otherwise a note says that the output does not.
"""

from collections.abc import Sequence
from pathlib import Path

from nanogs.io import registry
from nanogs.io.format import FormatOptions
from nanogs.io.parts import FileSource


def keep_stated_frame(
    path: Path, options: FormatOptions | None, inputs: Sequence[FileSource]
) -> tuple[FormatOptions | None, tuple[str, ...]]:
    """Add the frame of the inputs to the format options of an output, or return a note instead.

    Args:
        path: The output, a model that is not turned.
        options: Options of its format that were given.
        inputs: The files that the model comes from.

    Returns:
        The options, and notes for the user.

    Raises:
        FormatError: The part of an input that states the frame cannot be read.
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
        why = (
            f"but this kind of {known.suffix} file cannot state its axes; the model was not turned."
        )
    else:
        why = f"but {known.suffix} files have the axes {known.axes}; the model was not turned."
    return options, (f"The input states that its axes are {frame}, {why}",)
