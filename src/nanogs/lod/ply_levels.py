"""Writing levels as `level_0.ply`, the finest, and so on, with their `levels.json`."""

import json
from pathlib import Path

from nanogs.io import save
from nanogs.lod.chunks import Written
from nanogs.lod.manifest import NAME, Manifest
from nanogs.progress import Parts, untold
from nanogs.splats import Splats


class PlyLevels:
    """A folder that is being filled, level by level."""

    def __init__(self, folder: Path) -> None:
        """Begin; the folder exists and is empty."""
        self._folder = folder
        self._count = 0

    def add(self, splats: Splats, tell: Parts = untold) -> Written:
        """Write the next level, the finest first, in one part."""
        tell(0, 1)
        path = self._folder / level_name(self._count)
        save(splats, path)
        self._count += 1
        return Written((path.name,), path.stat().st_size)

    def finish(self, made: Manifest) -> None:
        """Write `levels.json`."""
        text = json.dumps(made.to_dict(), indent=2, allow_nan=False)
        (self._folder / NAME).write_text(text + "\n", encoding="utf-8")

    def losses(self, _splats: Splats) -> tuple[str, ...]:
        """Nothing: the files hold all of a model."""
        return ()


def level_name(level: int) -> str:
    """The file of a level; 0 is the finest."""
    return f"level_{level}.ply"
