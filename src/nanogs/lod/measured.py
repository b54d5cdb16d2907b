"""Holding levels against the model that they were made of, as files give them back."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.errors import ModelError
from nanogs.frames import change_frame
from nanogs.io import load, registry
from nanogs.lod.manifest import ChunkedLevel, Level, Manifest, judged_level
from nanogs.progress import Tracker
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.scoring.held_out import HeldOut


@dataclass(frozen=True, slots=True)
class LevelJudge:
    """Measures levels, or leaves them as they are where nothing can be measured.

    Attributes:
        views: The model as views show it that nothing is learnt from, or None.
        turn: Frames from and to which the levels were turned, or None.
        threads: Threads to use, or None for all.
        notes: Why nothing is measured.
    """

    views: "HeldOut | None" = None
    turn: tuple[str, str] | None = None
    threads: int | None = None
    notes: tuple[str, ...] = ()

    def of_file(self, level: Level | ChunkedLevel, path: Path) -> Level | ChunkedLevel:
        """The entry of a level in a file of its own, with what was measured."""
        return self._of(level, path, 0)

    def of_chunks(self, made: Manifest, described: Path) -> Manifest:
        """The entries of levels in chunks, which a file describes, with what was measured."""
        levels = enumerate(made.levels)
        return replace(made, levels=tuple(self._of(entry, described, n) for n, entry in levels))

    def _of(self, entry: Level | ChunkedLevel, path: Path, level: int) -> Level | ChunkedLevel:
        if self.views is None:
            return entry
        from nanogs.threads import use_threads

        with use_threads(self.threads):
            seen = load(path, level=level)
            if self.turn:
                seen = change_frame(seen, self.turn[1], self.turn[0])
            return judged_level(entry, self.views.judge(seen))


def level_judge(
    splats: Splats,
    suffix: str,
    turn: tuple[str, str] | None,
    threads: int | None,
    progress: Tracker,
) -> LevelJudge:
    """Render the model once, for all levels.

    Args:
        splats: The model.
        suffix: Format of the levels' files.
        turn: As `LevelJudge` has it, and so is `threads`.
        threads: See there.
        progress: Told of the views rendered.
    """
    known = registry.find(Path(f"level{suffix}"))
    if known and not known.readable:
        return LevelJudge(notes=(f"Nothing was measured: nanogs does not read {suffix} files.",))
    from nanogs.scoring.held_out import held_out
    from nanogs.threads import use_threads

    progress.begin("measure")
    with use_threads(threads):
        try:
            return LevelJudge(held_out(splats, progress.part), turn, threads)
        except ModelError as error:
            return LevelJudge(notes=(f"Nothing was measured: {error}",))
