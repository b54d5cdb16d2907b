"""Holding levels against the model that they were made of, as files give them back."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.errors import ModelError
from nanogs.frames import change_frame
from nanogs.io import load, registry
from nanogs.lod.manifest import ChunkedLevel, Level, Manifest
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

    def of(self, made: Manifest, files: Sequence[tuple[Path, int]]) -> Manifest:
        """The manifest with what was measured.

        Args:
            made: Without that.
            files: Each level's file, and its number in there.
        """
        made = replace(made, notes=(*made.notes, *self.notes))
        if self.views is None:
            return made
        levels = (self._of(*each, self.views) for each in zip(made.levels, files, strict=True))
        return replace(made, levels=tuple(levels), protocol=self.views.protocol)

    def _of(
        self, entry: Level | ChunkedLevel, file: tuple[Path, int], views: "HeldOut"
    ) -> Level | ChunkedLevel:
        from nanogs.threads import use_threads

        with use_threads(self.threads):
            seen = load(file[0], level=file[1])
            if self.turn:
                seen = change_frame(seen, self.turn[1], self.turn[0])
            judged = views.judge(seen)
        psnr = judged.psnr if math.isfinite(judged.psnr) else None  # JSON has no infinity
        return replace(entry, psnr=psnr, ssim=judged.ssim)


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
