"""Files of results in memory: how large they are, and what they show as they are read back."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nanogs.clock import StageClock
from nanogs.frames import change_frame
from nanogs.io import as_packed, as_stored, encoded_bytes, settled
from nanogs.pipeline.outcome import Outcome
from nanogs.report import PackingReport
from nanogs.scoring.held_out import ToChooseBy, to_choose_by
from nanogs.splats import Splats


@dataclass(eq=False)
class HeldFiles:
    """Writes results of a model in memory; see `wish.Files`.

    Attributes:
        path: What is going to be written; only its suffix counts.
        given: Options of its format that the user has chosen.
        original: The model.
        clock: Gets the seconds.
        frame: From and to which results are turned before they are written.
        by_psnr: Whether a PSNR is asked for, which is one of automatic views.
    """

    path: Path
    given: Mapping[str, Any]
    original: Splats
    clock: StageClock
    frame: tuple[str, str] | None = None
    by_psnr: bool = False

    @cached_property
    def views(self) -> ToChooseBy:
        """The original on views from which much is learnt, so that others can judge the result."""
        return to_choose_by(self.original, automatic=self.by_psnr)

    def count(self, result: Outcome) -> int:
        """As `Files` says."""
        return len(result.splats)

    def sample_bytes(self, some: Splats, options: Mapping[str, Any]) -> int:
        """As `Files` says."""
        with self.clock.time("encode"):
            return encoded_bytes(self._turned(some), self.path, {**self.given, **options})

    def bytes_of(self, result: Outcome, options: Mapping[str, Any]) -> int:
        """As `Files` says."""
        return self.sample_bytes(result.splats, options)

    def shows(self) -> bool:
        """As `Files` says."""
        with self.clock.time("measure"):
            return bool(self.views.kinds)

    def seen(self, result: Outcome, sh_degree: int, options: Mapping[str, Any]) -> PackingReport:
        """As `Files` says."""
        with self.clock.time("encode"):
            bare = self._turned(result.splats.with_sh_degree(sh_degree))
            options = {**options, **settled(bare, self.path, {**self.given, **options})}
            small, size = as_packed(bare, self.path, {**self.given, **options})
        with self.clock.time("measure"):
            psnr, ssim = self.views.judge(self._turned_back(small))
        return PackingReport(sh_degree, options, len(bare), size, psnr, ssim)

    def stored(self, splats: Splats, options: Mapping[str, Any]) -> Splats:
        """Splats as their file gives them back, in the frame of the original."""
        given = {**self.given, **options}
        return self._turned_back(as_stored(self._turned(splats), self.path, given))

    def _turned(self, splats: Splats) -> Splats:
        return change_frame(splats, *self.frame) if self.frame else splats

    def _turned_back(self, splats: Splats) -> Splats:
        return change_frame(splats, self.frame[1], self.frame[0]) if self.frame else splats
