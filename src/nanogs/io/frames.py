"""The coordinate frames of input files, and carrying the one they state over to the output file.

A model does not know its frame. If it is not turned, an output that can state a frame states that
of the input; otherwise a note says that the output does not.
"""

from collections.abc import Sequence
from pathlib import Path

from nanogs.errors import ModelError, OptionError
from nanogs.frames import TRAINED
from nanogs.io import registry
from nanogs.io.format import FormatOptions
from nanogs.io.parts import FileSource
from nanogs.source import Source
from nanogs.splats import Splats


def other_frames(models: Sequence[tuple[str, Splats | Source]]) -> tuple[str, ...]:
    """Note models that are in another frame than the first, since a comparison turns none.

    Of arrays, and of files that state no frame and whose format has none, it is not known.

    Args:
        models: Names and models.

    Raises:
        FormatError: The part of a file that states its frame cannot be read.
    """
    (first, own), *others = ((name, _known_frame(model)) for name, model in models)
    return tuple(
        f"{name} is in the frame {frame} and {first} in {own}, as the files state or by convention,"
        " and neither was turned; if the pictures do not match, turn one by `nanogs convert` with"
        " `frame`."
        for name, frame in others
        if own and frame not in ("", own)
    )


def _known_frame(model: Splats | Source) -> str:
    # The format of a file that was opened with `format` need not show in its name.
    if not isinstance(model, FileSource) or registry.find(model.path) is None:
        return ""
    return _frame_of(model, "")


def refuse_mixed_frames(inputs: Sequence[FileSource], before: str = "") -> tuple[str, ...]:
    """Refuse parts of one scene that are in different frames.

    A file that states no frame is in `before`, or in the usual frame of its format. If its format
    has none, it is taken to be in the frame of the other files.

    Args:
        inputs: The files that the model comes from.
        before: The frame from which the model is turned; empty if it is not turned.

    Returns:
        A note for the user if the frame of some files is a guess.

    Raises:
        FormatError: The part of an input that states the frame cannot be read.
        ModelError: They are in different frames.
    """
    names: dict[str, list[str]] = {}
    for each in inputs:
        names.setdefault(_frame_of(each, before), []).append(each.name)
    unstated = names.pop("", [])
    if len(names) > 1:
        (one, first), (other, second), *_ = ((frame, files[0]) for frame, files in names.items())
        raise ModelError(
            f"{first} is in the frame {one} and {second} in {other}, so they cannot form one scene;"
            " turn one of them first, by `nanogs convert` with `frame`."
        )
    if not unstated or not names:
        return ()
    [(frame, files)] = names.items()
    return (f"Taken to be in the frame {frame}, as {files[0]} is: {', '.join(unstated)}.",)


def _frame_of(file: FileSource, before: str) -> str:
    """Return the frame of a file as it is read; empty if that is not known."""
    known = registry.reader(file.path)
    return TRAINED if known.turns else file.frame or before or known.axes or ""


def refuse_frame_read(frame: tuple[str, str], inputs: Sequence[FileSource]) -> None:
    """Refuse frames from and to which a model is turned if its files are in another.

    Args:
        frame: Names of both frames, in lower case.
        inputs: The files that the model comes from.

    Raises:
        OptionError: An input is in another frame than the first.
    """
    before, after = frame
    for each in inputs:
        known = registry.reader(each.path)
        if known.turns and before != TRAINED:
            raise OptionError(
                f"{each.name} is turned to {TRAINED} when it is read, as all {known.suffix} files"
                f' are, but `frame` says {before}; give `frame=("{TRAINED}", "{after}")`.'
            )
        if not known.turns and known.axes is None and each.frame not in ("", before):
            raise OptionError(
                f"{each.name} states the frame {each.frame}, but `frame` says {before}; give"
                f' `frame=("{each.frame}", "{after}")`.'
            )


def refuse_frame_written(frame: tuple[str, str], output: Path) -> None:
    """Refuse frames from and to which a model is turned if its output has one of its own.

    Args:
        frame: Names of both frames, in lower case.
        output: The output; only its suffix counts.

    Raises:
        OptionError: All files of the output's format have the same frame, and it is not the second.
    """
    before, after = frame
    known = registry.writable(output)
    if known.turns and after != TRAINED:
        raise OptionError(
            f"All {known.suffix} files use the same frame, to which a model is turned from"
            f' {TRAINED} when it is written; give `frame=("{before}", "{TRAINED}")`.'
        )


def keep_stated_frame(
    path: Path, options: FormatOptions | None, inputs: Sequence[FileSource]
) -> tuple[FormatOptions | None, tuple[str, ...]]:
    """Add the frame of the inputs to the format options of an output, or return a note instead.

    Args:
        path: The output, a model that is not turned.
        options: Options of its format that were given.
        inputs: The files that the model comes from, which have one frame.

    Returns:
        The options, and notes for the user.

    Raises:
        FormatError: The part of an input that states the frame cannot be read.
        OptionError: The options state another frame than the inputs.
    """
    known, given = registry.find(path), options or {}
    frame = next((each.frame for each in inputs if each.frame), "")
    if known is None or not frame:
        return options, ()
    if asked := given.get("frame"):
        if asked != frame:
            raise OptionError(
                f"The input states the frame {frame}, but the format option `frame` says {asked};"
                f' turn the model, with `frame=("{frame}", "{asked}")`, or leave the option out.'
            )
        return options, ()
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
