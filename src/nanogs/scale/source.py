"""Input files as parts of one scene, read a segment of rows at a time."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from nanogs.errors import ModelError, OptionError
from nanogs.io import FileInfo, inspect, load
from nanogs.scale.inputs import check_unchanged, input_file, open_packed, open_rows
from nanogs.scale.settings import Access, InputFile, Layout, Segment, Settings
from nanogs.scale.unpack import Unpacked
from nanogs.splats import RenderMode, Splats, concatenate, padded

_SPAN_ROWS, _MOST_SPANS, _LEAST_SPANS = 1024, 256, 16  # of the rows that stand for all


def look_at(paths: Sequence[Path]) -> tuple[tuple[InputFile, ...], Layout]:
    """The files and the columns that their splats are brought to; no row is read.

    Raises:
        FormatError: One of them cannot be read.
        ModelError: They do not make one scene.
    """
    if not paths:
        raise OptionError("Give at least one file.")
    infos = [inspect(path) for path in paths]
    return tuple(input_file(info) for info in infos), _layout(infos)


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
        if file.splats > rows and file.access is Access.WHOLE:
            raise OptionError(
                f"{file.path}: files of this kind are not read in parts, and this one is too large"
                " to be read whole within the memory given; convert it to .ply, or raise"
                " `max_memory`."
            )
        parts = -(-file.splats // rows)
        bounds = [file.splats * part // parts for part in range(parts + 1)]
        segments += [Segment(number, *pair) for pair in pairwise(bounds)]
    return tuple(segments)


def read_segment(settings: Settings, segment: Segment, unpacked: Unpacked | None = None) -> Splats:
    """The splats of a segment, usable ones only, with the columns of the job.

    Args:
        settings: The job.
        segment: Which.
        unpacked: The files that have been unpacked, if any.

    Raises:
        FormatError: The file cannot be read, or has changed since the job began.
        ModelError: A splat holds a NaN or an infinite value, and that is to be an error.
    """
    file = settings.inputs[segment.file]
    with _opened(settings, segment.file, unpacked) as read:
        splats = read(segment.start, segment.stop)
    finite = splats.finite()
    if not finite.all():
        if settings.nan == "error":
            first = segment.start + int(np.argmin(finite))
            raise ModelError(
                f"{file.path}: row {first} holds a NaN or an infinite value; leave such"
                ' splats out with `nan="drop"`.'
            )
        splats = splats.take(finite)
    return _with_layout(splats, settings.layout)


def sample(settings: Settings, unpacked: Unpacked | None = None) -> Splats:
    """Evenly spread stretches of the usable rows of all inputs, without higher harmonics.

    They are some 260,000 at most, and no more than a block, so that memory for a block is enough.

    Args:
        settings: The job.
        unpacked: The files that have been unpacked, if any.

    Raises:
        FormatError: As for `read_segment`.
    """
    parts = []
    bare = replace(settings.layout, sh_degree=0, extras=())
    spans = min(max(settings.block // _SPAN_ROWS, _LEAST_SPANS), _MOST_SPANS)
    every = -(-settings.splats // (spans * _SPAN_ROWS))
    for number, file in enumerate(settings.inputs):
        with _opened(settings, number, unpacked) as read:
            for start in range(0, file.splats, _SPAN_ROWS * every):
                part = read(start, min(start + _SPAN_ROWS, file.splats)).with_sh_degree(0)
                parts.append(_with_layout(part.take(part.finite()), bare))
    return concatenate(parts)


@contextmanager
def _opened(
    settings: Settings, number: int, unpacked: Unpacked | None
) -> Iterator[Callable[[int, int], Splats]]:
    """Open a file to read rows of it; it must be the same before and after."""
    file = settings.inputs[number]
    check_unchanged(file)
    if unpacked is not None and number in unpacked.records:
        with unpacked.opened(number, open_packed(file)) as read:
            yield read
    elif file.access is Access.ROWS:
        yield open_rows(file).read
    else:
        yield load(file.path).span
    check_unchanged(file)


def load_joined(paths: Sequence[Path]) -> Splats:
    """Several files as one model, held whole.

    Raises:
        NanogsError: One of them cannot be read, or they do not make one scene.
    """
    _, layout = look_at(paths)
    parts = [_with_layout(load(path), layout) for path in paths]
    notes = dict.fromkeys([*layout.notes, *(note for part in parts for note in part.notes)])
    return replace(concatenate(parts), comments=layout.comments, notes=tuple(notes))


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
