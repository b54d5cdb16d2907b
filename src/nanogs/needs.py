"""How much memory looking at models and converting them takes: bytes, by counts alone.

Measured on half a million splats of SH degree 3; Python and its libraries come on top.
"""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from nanogs.io import FileInfo, inspect, registry
from nanogs.io.around import file_of
from nanogs.io.files import splat_bytes
from nanogs.io.format import FormatOptions
from nanogs.io.models import Model
from nanogs.io.parts import FileSource, Packed, Whole
from nanogs.io.spz.header import LAST_GZIP, column_widths
from nanogs.io.spz.packing import packing_bytes
from nanogs.source import Source
from nanogs.splats import Splats

_PREPARED, _DRAWN = 45, 136  # a splat: as the rasteriser reads it, and as one view lists it
_PICTURE, _KEPT = 90, 32  # a pixel: of the view at hand, and of each that is kept to compare with
_SHOWN = 16  # a pixel of a picture alone, with alpha
_PHOTO = 12  # a pixel of a photograph
_PACKED = 160  # a splat on a page: packed, as text, and in the page
_FITTED, _FITTING = 450, 1_900  # a splat of the original, and of the model that is fitted to it
_ROOM = 88  # a splat of the original, kept for its next view while a step is made
_FIT_KEPT = 8  # a pixel of each view that is fitted to
_READ = 1.4  # the model and what a reader of a packed file holds beside it, over the model
_WHOLE = 0.4  # what is held beside the model where something has to see all of it
_ROWS = 25_000_000  # blocks of rows on their way from file to file, filtered and turned
# A splat: of .spz of version 4 a column is packed whole, and .compressed.ply is sorted by centres.
_COLUMN = {".spz": 90, ".compressed.ply": 60}
_DOUBLE = 12  # more bytes for a centre in double precision
_STREAMED = 60_000_000  # blocks of rows that are read and projected, and rows to place cameras by
_COUNTED = 20  # a splat: what the percentiles of `info` are from; or, of many, their counts
_TALLIED = 80_000_000


def models_bytes(models: Sequence[Model], *, all_of_it: bool) -> int:
    """Bytes that reading models takes.

    Args:
        models: Models, or paths.
        all_of_it: Count those too that are held already.

    Raises:
        FormatError: A path is no model.
    """
    read = 0
    for model in models:
        if isinstance(model, str | PathLike):
            read += _read(inspect(model))
        elif isinstance(model, Source):
            read += model.count * splat_bytes(model.columns.sh_degree)
        elif isinstance(model, Splats) and all_of_it:
            read += len(model) * splat_bytes(model.sh_degree)
    return read


def streaming_bytes(source: Source) -> tuple[int, int]:
    """Rendering a model some rows at a time, beside the pictures and the splats that they draw.

    Returns:
        Bytes that it takes throughout, and those that it takes before any splat is held.
    """
    source = file_of(source)
    if isinstance(source, Packed):
        return _STREAMED, source.memory
    return _STREAMED + (_held(source) if isinstance(source, FileSource) else 0), 0


def model_bytes(info: FileInfo) -> int:
    """Bytes of the model as loaded."""
    row = splat_bytes(info.sh_degree) + info.extra_bytes() + _DOUBLE * info.double_means
    return info.splats * row


def drawn_bytes(splats: int) -> int:
    """So many splats while a view of them is rendered, beside the model."""
    return splats * (_PREPARED + _DRAWN)


def shown_bytes(pixels: int, views: int) -> int:
    """Pictures that are kept, and the view at hand."""
    return pixels * (_PICTURE + _SHOWN * views)


def compare_bytes(infos: Sequence[FileInfo], pixels: int, views: int, *, paged: bool) -> int:
    """Scoring models against the first of them.

    Args:
        infos: The models.
        pixels: Of a view.
        views: Their number.
        paged: Whether the models are put into a page.
    """
    held = sum(map(model_bytes, infos))
    scoring = scoring_bytes([info.splats for info in infos], pixels, views)
    return max(page_bytes(infos) if paged else held, held + scoring)


def scoring_bytes(counts: Sequence[int], pixels: int, views: int) -> int:
    """Scoring models against the first of them, beside the models themselves.

    Args:
        counts: Splats of each.
        pixels: Of a view.
        views: Their number.
    """
    return counts[0] * _PREPARED + max(counts) * _DRAWN + pictures_bytes(pixels, views)


def pictures_bytes(pixels: int, views: int) -> int:
    """Views of the original to compare with, and the one at hand."""
    return pixels * (_PICTURE + _KEPT * views)


def photographs_bytes(pixels: Sequence[int]) -> int:
    """Photographs to compare with, of so many pixels each, and the view at hand."""
    return _PHOTO * sum(pixels) + (_PICTURE + _KEPT) * max(pixels, default=0)


def page_bytes(infos: Sequence[FileInfo]) -> int:
    """A page that shows models."""
    return sum(model_bytes(info) + info.splats * _PACKED for info in infos)


def refit_bytes(original: FileInfo, small: FileInfo, pixels: int, views: int) -> int:
    """Fitting a model to renders of the original.

    Args:
        original: The original.
        small: The model.
        pixels: Of a view.
        views: To fit to, and to decide by.
    """
    held = model_bytes(original) + 2 * model_bytes(small)
    stepping = original.splats * _ROOM + small.splats * _FITTING
    working = original.splats * _PREPARED + max(original.splats * _FITTED, stepping)
    return held + working + pixels * (_PICTURE + _FIT_KEPT * views)


def convert_bytes(
    source: FileSource, target: Path, *, whole: bool, options: FormatOptions | None = None
) -> int:
    """Writing a model in another format.

    Args:
        source: The model.
        target: What is written.
        whole: Whether something has to see the whole model, in whatever format.
        options: Of the format that is written.
    """
    info, known = source.info, registry.find(target)
    held = known is None or known.holds_whole(options or {})
    if known is not None and not held and not whole:
        return _held(source) + _ROWS + _columns_bytes(known.suffix, info)
    model = model_bytes(info)
    more = known.beside(model) if known is not None and held else int(_WHOLE * model)
    return max(_read(info), model + more)


def _columns_bytes(suffix: str, info: FileInfo) -> int:
    """Columns that a writer of rows holds whole."""
    each = _COLUMN.get(suffix, 0) * info.splats
    if suffix != ".spz":
        return each
    columns = sum(column_widths(LAST_GZIP, info.sh_degree).values()) * info.splats
    return max(each, packing_bytes(columns))


def info_bytes(source: FileSource) -> int:
    """Describing a model."""
    return _held(source) + min(source.count * _COUNTED, _TALLIED)


def _held(given: FileSource) -> int:
    """Bytes that reading in parts holds: the whole, of formats that can only be read so."""
    source = file_of(given)
    if isinstance(source, Whole):
        return _read(source.info)
    return source.memory if isinstance(source, Packed) else 0


def _read(info: FileInfo) -> int:
    return int(model_bytes(info) * (1.0 if info.format == "ply" else _READ))
