"""The layouts in which `nanogs lod` writes levels.

The output's name decides: `out/lod-meta.json`, `out/tileset.json`, `out.rad`, a `.ssog` file, or
a folder.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from nanogs._types import F64
from nanogs.defaults import CHUNK, LEAST_CHUNK
from nanogs.errors import OptionError
from nanogs.formatting import listed
from nanogs.io import registry
from nanogs.io.rad.write import SUFFIX as TREE
from nanogs.lod.chunks import ChunkLayout
from nanogs.lod.folder import PLY, level_name
from nanogs.lod.streamed_sog import StreamedSog
from nanogs.lod.tiles import Tiles
from nanogs.lod.tree_blocks import Linked
from nanogs.paths import suggested
from nanogs.place import Place, columns, transform_of
from nanogs.ranges import is_number, value_text

MOST_CHUNK = 2**31 - 1  # splats


class LodLayout(StrEnum):
    """The layouts of levels in files."""

    FILES = "files"  # one per level
    SOG = "streamed sog"
    TILES = "3d tiles"
    TREE = "spark tree"  # one file
    ARCHIVE = "streamed sog archive"  # one file


_IN_FOLDERS: dict[LodLayout, type[ChunkLayout]] = {
    LodLayout.SOG: StreamedSog,
    LodLayout.TILES: Tiles,
}
_CHUNKED = _IN_FOLDERS | {LodLayout.ARCHIVE: StreamedSog}
NAMES = {layout: chunked.name for layout, chunked in _IN_FOLDERS.items()}
_FILES = {LodLayout.TREE: TREE, LodLayout.ARCHIVE: registry.ARCHIVE}


@dataclass(frozen=True, slots=True)
class Output:
    """The path and layout of the levels to write.

    Attributes:
        folder: The folder to make, or the file for layouts of one file.
        layout: The layout.
        suffix: Suffix of the files in the layout with one file per level.
    """

    folder: Path
    layout: LodLayout
    suffix: str = PLY

    @property
    def path(self) -> Path:
        """The path that a viewer opens: the file that describes the folder, or the folder."""
        return self.folder / NAMES.get(self.layout, "")

    @property
    def model(self) -> Path:
        """An example path of a model file in the folder; all have the same suffix."""
        known = _CHUNKED.get(self.layout)
        return self.folder / level_name(0, known.suffix if known else self.suffix)


def output_of(path: Path, suffix: str | None = None) -> Output:
    """Derive the folder and the layout from the name of the output.

    Args:
        path: The folder, the file in it that describes the levels, or the single file.
        suffix: Format of the levels' files, with or without its dot; .ply by default.

    Raises:
        OptionError: The format cannot be written, or the name implies another one; or the name is
            that of another `.json` file, of a picture, or of a single model.
    """
    for layout, ending in _FILES.items():
        if path.suffix.lower() == ending:
            if suffix is not None:
                raise OptionError(
                    f"The format cannot be chosen, because {path} already determines it; leave it"
                    " out."
                )
            return Output(path, layout, TREE if layout == LodLayout.TREE else PLY)
    for layout, name in NAMES.items():
        if path.name == name:
            if suffix is not None:
                raise OptionError(
                    f"The format cannot be chosen, because {name} already determines it; name a"
                    " folder for files in another format."
                )
            return Output(path.parent, layout)
    _refuse_files(path)
    if suffix is None:
        return Output(path, LodLayout.FILES)
    ending = registry.suffix_of(suffix)
    for name in (*NAMES.values(), registry.ARCHIVE):
        if ending.endswith(name):
            whole = suggested(path, name) if name == registry.ARCHIVE else path / name
            raise OptionError(
                f"{suffix} describes all levels, and `format` is that of a file for each; leave it"
                f" out, and name {whole}."
            )
    registry.writer(registry.file_of(suffix))
    return Output(path, LodLayout.FILES, ending)


def _refuse_files(path: Path) -> None:
    """Refuse the names of other `.json` files, of pictures and of single models as a folder.

    Raises:
        OptionError: It is one.
    """
    if path.suffix.lower() == ".json":
        described = path.name in (registry.META, registry.LEVEL_LIST)  # of another format
        folder = path.parent if described else path.parent / path.stem
        raise OptionError(
            f"{path}: levels are described by a file called {listed(NAMES.values(), 'or')}; name"
            f" that, as in {folder / StreamedSog.name}, or a folder."
        )
    if path.suffix.lower() in registry.PICTURES:
        raise OptionError(f"{path} names a picture; name a folder, as in {path.with_suffix('')}/.")
    if known := registry.find(path):
        given = f', and give `format="{known.suffix.lstrip(".")}"`' if known.write else ""
        raise OptionError(
            f"{path} is the name of one {known.suffix} file, but there are several levels: name a"
            f" folder, as in {path.with_suffix('')}/{given}."
        )


def refuse_misnamed(path: Path, layout: LodLayout) -> None:
    """Refuse a name that does not fit the layout: a file for a folder, or another suffix.

    Raises:
        OptionError: It does not fit.
    """
    ending, known = _FILES.get(layout), registry.find(path)
    if ending and path.suffix.lower() != ending:
        raise OptionError(
            f'{path}: the layout "{layout}" is one {ending} file; name that, as in'
            f" {suggested(path, ending)}."
        )
    if known and not ending:
        folder = path.parent if path.name in NAMES.values() else path.with_suffix("")
        raise OptionError(
            f'{path} is the name of one file, but the layout "{layout}" is a folder; name that, as'
            f" in {folder}."
        )


def block_layout_of(
    layout: LodLayout | str,
    chunk: int | None,
    chunk_min: int | None = None,
    *,
    plain: bool,
    place: Place | Sequence[Sequence[float]] | F64 | None = None,
) -> ChunkLayout | Linked | None:
    """Return the object that divides or links levels for a layout; None for one file per level.

    Args:
        layout: The layout.
        chunk: Most splats of a chunk of the finest level; `CHUNK` by default.
        chunk_min: Least splats of such a chunk, and of a file of streamed SOG; by default
            `LEAST_CHUNK`, or a quarter of `chunk` if that is less.
        plain: Whether the contents of 3D Tiles are unpacked.
        place: The place on Earth of 3D Tiles, as `transform_of` takes it; None for none.

    Raises:
        OptionError: There is no such layout; the size of chunks is below 1, no whole number, or
            given for a layout without chunks; the least is more than half of the most; unpacked
            contents or a place are requested for another layout than 3D Tiles; or the place is
            invalid.
    """
    if layout not in list(LodLayout):
        known = ", ".join(f'"{each}"' for each in LodLayout)
        raise OptionError(f'There is no layout "{layout}"; choose from {known}.')
    sized = chunk is not None or chunk_min is not None
    if sized and layout == LodLayout.FILES:
        raise OptionError(
            "The size of chunks can be given only for lod-meta.json, .ssog and tileset.json,"
            " because levels in separate files are not divided; leave it out."
        )
    if sized and layout == LodLayout.TREE:
        raise OptionError(
            "The size of chunks cannot be given for a .rad file, because viewers expect 65,536"
            " splats; leave it out."
        )
    if plain and layout != LodLayout.TILES:
        raise OptionError("Plain contents are possible only in 3D Tiles; write a tileset.json.")
    if place is not None and layout != LodLayout.TILES:
        raise OptionError("A place on Earth is possible only in 3D Tiles; write a tileset.json.")
    most = CHUNK if chunk is None else _whole(chunk)
    least = max(min(LEAST_CHUNK, most // 4), 1) if chunk_min is None else _whole(chunk_min)
    if layout == LodLayout.TILES:
        put = None if place is None else columns(transform_of(place))
        return Tiles(most, least, packed=not plain, place=put)
    if layout == LodLayout.TREE:
        return Linked()
    return StreamedSog(most, least) if layout in (LodLayout.SOG, LodLayout.ARCHIVE) else None


def _whole(size: int) -> int:
    """Convert a chunk size to a Python int, because jobs store it as JSON.

    Raises:
        OptionError: It is not a whole number, or beyond 32 bits.
    """
    if not (is_number(size, whole=True) and size <= MOST_CHUNK):
        raise OptionError(
            f"The size of a chunk must be a whole number of splats, not {value_text(size)}, and at"
            f" most {MOST_CHUNK:,}."
        )
    return int(size)
