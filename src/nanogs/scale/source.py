"""Input files as parts of one scene, read a segment of rows at a time."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from nanogs.errors import FormatError, ModelError, OptionError
from nanogs.io import FileInfo, inspect, load, ply
from nanogs.io.registry import find
from nanogs.scale.settings import InputFile, Layout, Segment, Settings
from nanogs.splats import RenderMode, Splats, concatenate, padded

_SPANS, _SPAN_ROWS = 256, 1024  # of the rows that stand for all


def look_at(paths: Sequence[Path]) -> tuple[tuple[InputFile, ...], Layout]:
    """The files and the columns that their splats are brought to; no row is read.

    Raises:
        FormatError: One of them cannot be read.
        ModelError: They do not make one scene.
    """
    if not paths:
        raise OptionError("Give at least one file.")
    infos = [inspect(path) for path in paths]
    return tuple(_input_file(info) for info in infos), _layout(infos)


def _input_file(info: FileInfo) -> InputFile:
    status = info.path.stat()
    known = find(info.path)
    is_ply = known is not None and known.read is ply.read
    seekable = is_ply and ply.seekable(info.path)
    where = str(info.path.resolve())
    return InputFile(where, status.st_size, status.st_mtime_ns, info.splats, seekable)


def _layout(infos: Sequence[FileInfo]) -> Layout:
    modes = {info.render_mode for info in infos}
    if len(modes) > 1:
        raise ModelError(
            "The inputs are for different renderers "
            f"({', '.join(sorted(map(str, modes)))}) and make no one scene; simplify them apart."
        )
    columns = [{name: _dtype(info, name) for name in info.extras} for info in infos]
    shared = {
        name: kind
        for name, kind in columns[0].items()
        if all(each.get(name) == kind for each in columns)
    }
    left = sorted({name for each in columns for name in each} - set(shared))
    notes = [f"Extra columns that not all inputs have are left out: {', '.join(left)}."] * any(left)
    if len({info.sh_degree for info in infos}) > 1:
        notes.append("The inputs' SH degrees differ: coefficients that one lacks are 0.")
    if any(rows for info in infos for _, rows in info.elements):
        notes.append("Further elements of the inputs are left out: blocks hold splats alone.")
    return Layout(
        sh_degree=max(info.sh_degree for info in infos),
        double_means=any(info.double_means for info in infos),
        extras=tuple(shared.items()),
        render_mode=str(infos[0].render_mode),
        comments=tuple(infos[0].comments),
        notes=tuple(notes),
    )


_TYPES = {
    "char": "|i1", "uchar": "|u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "float": "<f4", "double": "<f8",
}  # fmt: skip


def _dtype(info: FileInfo, name: str) -> str:
    kind = dict(info.properties)[name]
    return _TYPES.get(kind) or np.dtype(kind).str


def segments_of(inputs: Sequence[InputFile], rows: int) -> tuple[Segment, ...]:
    """All rows in segments of about equal size.

    Args:
        inputs: The files.
        rows: Most of a segment.

    Raises:
        OptionError: A file that cannot be read in parts has more.
    """
    segments = []
    for number, file in enumerate(inputs):
        if file.splats > rows and not file.seekable:
            raise OptionError(
                f"{file.path}: only a binary .ply is read in parts, and this file is too large to"
                " be read whole within the memory given; convert it, or raise --max-memory."
            )
        parts = -(-file.splats // rows)
        bounds = [file.splats * part // parts for part in range(parts + 1)]
        segments += [Segment(number, *pair) for pair in pairwise(bounds)]
    return tuple(segments)


def read_segment(settings: Settings, segment: Segment) -> Splats:
    """The splats of a segment, usable ones only, with the columns of the job.

    Raises:
        FormatError: The file cannot be read, or has changed since the job began.
        ModelError: A splat holds a NaN or an infinite value, and that is to be an error.
    """
    file = settings.inputs[segment.file]
    splats = _read(file, segment.start, segment.stop)
    finite = splats.finite()
    if not finite.all():
        if settings.nan == "error":
            first = segment.start + int(np.argmin(finite))
            raise ModelError(
                f"{file.path}: row {first} holds a NaN or an infinite value; --nan drop leaves"
                " such splats out."
            )
        splats = splats.take(finite)
    return _with_layout(splats, settings.layout)


def sample(settings: Settings) -> Splats:
    """Evenly spread stretches of the usable rows of all inputs, some 260,000 at most."""
    parts = []
    every = max(settings.splats // (_SPANS * _SPAN_ROWS), 1)
    for file in settings.inputs:
        if file.seekable:
            starts = range(0, file.splats, _SPAN_ROWS * every)
            spans = [(start, min(start + _SPAN_ROWS, file.splats)) for start in starts]
            found = [_read(file, *span) for span in spans]
        else:
            found = [_read(file, 0, file.splats).take(slice(None, None, every))]
        parts += [_with_layout(part.take(part.finite()), settings.layout) for part in found]
    return concatenate(parts)


def load_joined(paths: Sequence[Path]) -> Splats:
    """Several files as one model, held whole.

    Raises:
        NanogsError: One of them cannot be read, or they do not make one scene.
    """
    _, layout = look_at(paths)
    parts = [_with_layout(load(path), layout) for path in paths]
    notes = dict.fromkeys([*layout.notes, *(note for part in parts for note in part.notes)])
    return replace(concatenate(parts), comments=layout.comments, notes=tuple(notes))


def _read(file: InputFile, start: int, stop: int) -> Splats:
    path = Path(file.path)
    if not path.exists():
        raise FormatError(
            f"{path} is not there; the caller and all workers must see the inputs under one name."
        )
    status = path.stat()
    if (status.st_size, status.st_mtime_ns) != (file.bytes, file.modified):
        raise FormatError(f"{path} has changed since the job began; begin it anew.")
    if file.seekable:
        return ply.read_span(path, start, stop)
    splats = load(path)
    return splats if (start, stop) == (0, len(splats)) else splats.span(start, stop)


def _with_layout(splats: Splats, layout: Layout) -> Splats:
    coefficients = (layout.sh_degree + 1) ** 2
    means = splats.means.astype(np.float64) if layout.double_means else splats.means
    return Splats(
        means=means,
        log_scales=splats.log_scales,
        quats=splats.quats,
        opacity_logits=splats.opacity_logits,
        sh=padded(splats.sh, coefficients),
        extras={name: splats.extras[name].astype(kind) for name, kind in layout.extras},
        render_mode=RenderMode(layout.render_mode),
        notes=splats.notes,
    )
