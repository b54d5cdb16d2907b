"""The layouts in which `nanogs lod` writes levels, and the folders that it may replace.

The output's name says which: `out/lod-meta.json`, `out/tileset.json`, or the folder itself.
"""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from nanogs.defaults import CHUNK
from nanogs.errors import OptionError
from nanogs.io import registry
from nanogs.lod import manifest, streamed_sog, tiles
from nanogs.lod.chunks import Written, check_chunk
from nanogs.lod.file_levels import PLY, FileLevels, level_name
from nanogs.lod.manifest import Manifest
from nanogs.progress import Parts, untold
from nanogs.splats import Splats


class Layout(StrEnum):
    """How the levels lie in the folder."""

    FILES = "files"  # one a level
    SOG = "streamed sog"
    TILES = "3d tiles"


NAMES = {Layout.SOG: streamed_sog.NAME, Layout.TILES: tiles.NAME}


@dataclass(frozen=True, slots=True)
class Output:
    """The place and form of the levels.

    Attributes:
        folder: The folder to make.
        layout: How they lie in it.
        suffix: Of the files, where each level has one.
    """

    folder: Path
    layout: Layout
    suffix: str = PLY

    @property
    def path(self) -> Path:
        """The path that a viewer opens: the file that describes the folder, or the folder."""
        return self.folder / NAMES.get(self.layout, "")

    @property
    def model(self) -> Path:
        """The name of one model in it, whose suffix is that of all."""
        suffix = {Layout.SOG: ".sog", Layout.TILES: ".glb"}.get(self.layout, self.suffix)
        return self.folder / level_name(0, suffix)


def output_of(path: Path, suffix: str | None = None) -> Output:
    """The folder and the layout that a name asks for.

    Args:
        path: The folder, or the file in it that describes the levels.
        suffix: Format of the levels' files, with or without its dot; .ply by default.

    Raises:
        OptionError: The format is not written, or the name says another one; or the name is that of
            another `.json` file, or of a single model.
    """
    for layout, name in NAMES.items():
        if path.name == name:
            if suffix is not None:
                raise OptionError(
                    f"{name} says how the levels are written; name a folder for files in another"
                    " format."
                )
            return Output(path.parent, layout)
    if path.suffix.lower() == ".json":
        raise OptionError(
            f"{path}: levels are described by a file called {' or '.join(NAMES.values())}; name"
            f" that, as in {path.parent / path.stem / streamed_sog.NAME}, or a folder."
        )
    if known := registry.find(path):
        raise OptionError(
            f"{path} is the name of one {known.suffix} file, and levels are several: name a folder,"
            f' as in {path.with_suffix("")}/, and give `format="{known.suffix.lstrip(".")}"`.'
        )
    if suffix is None:
        return Output(path, Layout.FILES)
    ending = registry.suffix_of(suffix)
    registry.writer(Path(level_name(0, ending)))
    return Output(path, Layout.FILES, ending)


class LevelWriter(Protocol):
    """Writes levels into a folder, one after the other."""

    def add(self, splats: Splats, tell: Parts = untold) -> Written:
        """Write the next level, the finest first, and tell how many of its splats are written."""

    def finish(self, made: Manifest) -> None:
        """Write what describes the folder."""

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that the files leave out, one sentence each."""


def check_options(layout: Layout, chunk: int | None, *, plain: bool) -> None:
    """Refuse what makes no sense for a layout.

    Raises:
        OptionError: The size of chunks is below 1 or given for a layout without chunks, or plain
            contents are asked for outside of 3D Tiles.
    """
    if chunk is not None and layout is Layout.FILES:
        raise OptionError(
            "The size of chunks is for lod-meta.json and tileset.json; levels as files of their"
            " own are not divided."
        )
    if chunk is not None:
        check_chunk(chunk)
    if plain and layout is not Layout.TILES:
        raise OptionError("Contents are plain or packed in 3D Tiles only; write a tileset.json.")


def writer(
    layout: Layout, folder: Path, chunk: int | None, *, plain: bool, suffix: str = PLY
) -> LevelWriter:
    """Make the writer of a layout, into a folder that exists and is empty.

    Args:
        layout: How the levels are to lie.
        folder: Where to.
        chunk: Most splats of a chunk of the finest level; `CHUNK` by default.
        plain: Whether the contents of 3D Tiles are not packed.
        suffix: Of levels in files of their own.

    Raises:
        OptionError: As for `check_options`.
    """
    check_options(layout, chunk, plain=plain)
    most = CHUNK if chunk is None else chunk
    if layout is Layout.SOG:
        return streamed_sog.StreamedSog(folder, most)
    if layout is Layout.TILES:
        return tiles.Tiles(folder, most, plain=plain)
    return FileLevels(folder, suffix)


def made_files(folder: Path) -> frozenset[str] | None:
    """The files of a folder that `nanogs lod` made, in any layout; None for other folders."""
    owners = (manifest.made_files, streamed_sog.made_files, tiles.made_files)
    known = [names for made in owners if (names := made(folder)) is not None]
    return frozenset[str]().union(*known) if known else None
