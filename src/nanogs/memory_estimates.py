"""Estimates of the memory, in bytes, for rendering, measuring and converting models.

They follow from counts alone. The constants were measured on half a million splats of SH degree 3;
Python and its libraries come on top.
"""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from nanogs.io import FileInfo, inspect, registry
from nanogs.io.files import splat_bytes
from nanogs.io.format import FormatOptions
from nanogs.io.models import Model
from nanogs.io.parts import FileSource, Packed, Whole
from nanogs.io.wrapper import unwrapped
from nanogs.source import Source
from nanogs.splats import Splats

# Bytes for each splat: as prepared for the rasteriser, and as projected and listed for one view.
_PREPARED, _DRAWN = 45, 136
# Bytes for each pixel: of the view being rendered, and of each view kept for comparison.
_PICTURE, _KEPT = 90, 32
_SHOWN = 16  # bytes for each pixel of a picture alone, with alpha
_PHOTO = 12  # bytes for each pixel of a photograph
_PACKED = 160  # bytes for each splat on a page: packed, as text, and in the page
# Bytes for each splat of the original, and of the model that is fitted to it.
_FITTED, _FITTING = 450, 1_900
_ROOM = 88  # bytes for each splat of the original, kept for its next view during a step
_FIT_KEPT = 8  # bytes for each pixel of each view that is fitted to
_READ = 1.4  # peak while reading a packed file, over the size of the model
# The same for formats whose parts are joined or converted as a whole, and for unpacked ones.
_READ_BY = {"ply": 1.0, "checkpoint": 1.9, "rad": 2.0, "3d tiles": 2.0}
_READ_PACKED_GLTF = 2.4  # the same for glTF packed as SPZ, which is decoded to a model of its own
_GLTF, _PLAIN = ("glb", "gltf", "3d tiles"), "binary_little_endian"
_WHOLE = 0.4  # extra memory if the whole model must be held, over its size
_ROWS = 25_000_000  # bytes for blocks of rows that are read, filtered, turned and written
# Bytes for each splat: .spz of version 4 packs a whole column, .compressed.ply sorts by centres.
_COLUMN = {".spz": 90, ".compressed.ply": 60}
_DOUBLE = 12  # extra bytes for a centre in double precision
_STREAMED = 60_000_000  # bytes for blocks of rows being projected, and rows to place cameras by
# Percentiles of `info`: bytes for each splat, or for the counts if there are many splats.
_COUNTED = 20
_TALLIED = 80_000_000


def models_bytes(models: Sequence[Model], *, all_of_it: bool) -> int:
    """Estimate the bytes for reading models.

    Args:
        models: Models, or paths.
        all_of_it: Also count models that are in memory already.

    Raises:
        FormatError: A path is no model.
    """
    read = 0
    for model in models:
        if isinstance(model, str | PathLike):
            read += _read(inspect(model))
        elif isinstance(model, FileSource):
            read += _read(model.info)
        elif isinstance(model, Source):
            read += model.count * splat_bytes(model.columns.sh_degree)
        elif isinstance(model, Splats) and all_of_it:
            read += len(model) * splat_bytes(model.sh_degree)
    return read


def streaming_bytes(source: Source) -> tuple[int, int]:
    """Estimate the bytes for streaming a model while rendering, without pictures and their splats.

    Returns:
        Bytes that are held throughout, and bytes that are held only before any splat is kept.
    """
    source = unwrapped(source)
    if isinstance(source, Packed):
        return _STREAMED, source.memory
    return _STREAMED + (_held(source) if isinstance(source, FileSource) else 0), 0


def model_bytes(info: FileInfo) -> int:
    """Compute the bytes of the loaded model."""
    row = splat_bytes(info.sh_degree) + info.extra_bytes() + _DOUBLE * info.double_means
    return info.splats * row


def drawn_bytes(splats: int) -> int:
    """Estimate the extra bytes for a number of splats while a view of them is rendered."""
    return splats * (_PREPARED + _DRAWN)


def shown_bytes(pixels: int, views: int) -> int:
    """Estimate the bytes for the pictures that are kept and the view being rendered."""
    return pixels * (_PICTURE + _SHOWN * views)


def compare_bytes(infos: Sequence[FileInfo], pixels: int, views: int, photographs: int = 0) -> int:
    """Estimate the bytes for scoring models against the first, and for a page with all of them.

    Args:
        infos: The models.
        pixels: Number of pixels of a view.
        views: Number of views.
        photographs: Bytes of photographs that are held while models are scored.
    """
    scoring = photographs + scoring_bytes([info.splats for info in infos], pixels, views)
    return max(page_bytes(infos), sum(map(model_bytes, infos)) + scoring)


def scoring_bytes(counts: Sequence[int], pixels: int, views: int) -> int:
    """Estimate the bytes for scoring models against the first, without the models themselves.

    Args:
        counts: Number of splats of each model.
        pixels: Number of pixels of a view.
        views: Number of views.
    """
    return counts[0] * _PREPARED + max(counts) * _DRAWN + pictures_bytes(pixels, views)


def pictures_bytes(pixels: int, views: int) -> int:
    """Estimate the bytes for the kept views of the original and the view being rendered."""
    return pixels * (_PICTURE + _KEPT * views)


def photographs_bytes(pixels: Sequence[int]) -> int:
    """Compute the bytes for holding photographs, of `pixels` each."""
    return _PHOTO * sum(pixels)


def page_bytes(infos: Sequence[FileInfo]) -> int:
    """Estimate the bytes for making a page that shows models."""
    return sum(model_bytes(info) + info.splats * _PACKED for info in infos)


def refit_bytes(original: FileInfo, small: FileInfo, target: Path, pixels: int, views: int) -> int:
    """Estimate the bytes for fitting a model to renders of the original, and for writing it.

    Args:
        original: The original.
        small: The model.
        target: The file to write. If it has a palette, that is computed before the fit.
        pixels: Number of pixels of a view.
        views: Number of views, to fit to and to validate.
    """
    held = model_bytes(original) + 2 * model_bytes(small)
    stepping = original.splats * _ROOM + small.splats * _FITTING
    known = registry.writable(target)
    packing = known.extra_memory(model_bytes(small)) if known.needs_whole_model({}) else 0
    working = original.splats * _PREPARED + max(original.splats * _FITTED, stepping, packing)
    return held + working + pixels * (_PICTURE + _FIT_KEPT * views)


def convert_bytes(
    source: FileSource, target: Path, *, whole: bool, options: FormatOptions | None = None
) -> int:
    """Estimate the bytes for writing a model in another format.

    Args:
        source: The model.
        target: The file to write.
        whole: Whether the whole model must be held regardless of the format.
        options: Options of the target's format.
    """
    info, known = source.info, registry.find(target)
    held = known is None or known.needs_whole_model(options or {})
    if known is not None and not held and not whole:
        return _held(source) + _ROWS + _columns_bytes(known.suffix, info)
    model = model_bytes(info)
    more = known.extra_memory(model) if known is not None and held else int(_WHOLE * model)
    return max(_read(info), model + more)


def _columns_bytes(suffix: str, info: FileInfo) -> int:
    """Estimate the bytes of the columns that a streaming writer holds whole."""
    each = _COLUMN.get(suffix, 0) * info.splats
    if suffix != ".spz":
        return each
    # Imported here, because it takes time when a command starts, and few need it.
    from nanogs.io.spz.header import LAST_GZIP, column_widths
    from nanogs.io.spz.packing import packing_bytes

    columns = sum(column_widths(LAST_GZIP, info.sh_degree).values()) * info.splats
    return max(each, packing_bytes(columns))


def info_bytes(source: FileSource) -> int:
    """Estimate the bytes for describing a model by `info`."""
    return _held(source) + min(source.count * _COUNTED, _TALLIED)


def _held(given: FileSource) -> int:
    """Estimate the bytes that streaming a source holds: all of a format that is only read whole."""
    source = unwrapped(given)
    if isinstance(source, Whole):
        return _read(source.info)
    return source.memory if isinstance(source, Packed) else 0


def _read(info: FileInfo) -> int:
    """Estimate the bytes for reading a whole model, the model included."""
    model = model_bytes(info)
    if info.format == "usda":  # the text, and the numbers of an array in pieces and joined
        return info.file_bytes + 2 * model
    packed_gltf = info.format in _GLTF and info.encoding != _PLAIN
    return int(model * (_READ_PACKED_GLTF if packed_gltf else _READ_BY.get(info.format, _READ)))
