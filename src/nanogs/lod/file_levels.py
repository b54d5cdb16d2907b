"""Writing levels as files: `level_0`, the finest, and so on, with their `levels.json`."""

import json
from pathlib import Path

from nanogs.io import losses, save
from nanogs.lod.chunks import Written
from nanogs.lod.manifest import NAME, Manifest
from nanogs.progress import Parts, untold
from nanogs.splats import Splats

PLY = ".ply"


class FileLevels:
    """A folder that is being filled, level by level."""

    def __init__(self, folder: Path, suffix: str = PLY) -> None:
        """Begin; the folder exists and is empty, and the suffix is of a format that is written."""
        self._folder, self._suffix = folder, suffix
        self._count = 0

    def add(self, splats: Splats, tell: Parts = untold) -> Written:
        """Write the next level, the finest first, in one part."""
        tell(0, 1)
        path = self._folder / level_name(self._count, self._suffix)
        save(splats, path)
        self._count += 1
        return Written((path.name,), path.stat().st_size)

    def finish(self, made: Manifest) -> None:
        """Write `levels.json`."""
        text = json.dumps(made.to_dict(), indent=2, allow_nan=False)
        (self._folder / NAME).write_text(text + "\n", encoding="utf-8")

    def losses(self, splats: Splats) -> tuple[str, ...]:
        """Name the parts of a model that the files leave out, one sentence each."""
        return losses(splats, level_name(0, self._suffix))


def level_name(level: int, suffix: str = PLY) -> str:
    """The file of a level; 0 is the finest."""
    return f"level_{level}{suffix}"
