"""Files of results in memory: how large they are, and what they show as they are read back."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nanogs.clock import StageClock
from nanogs.io import as_packed, encoded_bytes
from nanogs.pipeline.outcome import Outcome
from nanogs.scoring.held_out import HeldOut, held_out
from nanogs.splats import Splats


@dataclass(eq=False)
class HeldFiles:
    """Writes results of a model in memory; see `wish.Files`.

    Attributes:
        path: What is going to be written; only its suffix counts.
        given: Options of its format that the user has chosen.
        original: The model.
        clock: Gets the seconds.
    """

    path: Path
    given: Mapping[str, Any]
    original: Splats
    clock: StageClock

    @cached_property
    def views(self) -> HeldOut:
        """The original on views from which much is learnt, so that others can judge the result."""
        return held_out(self.original, split="fit")

    def count(self, result: Outcome) -> int:
        """As `Files` says."""
        return len(result.splats)

    def sample_bytes(self, some: Splats, options: Mapping[str, Any]) -> int:
        """As `Files` says."""
        with self.clock.time("encode"):
            return encoded_bytes(some, self.path, {**self.given, **options})

    def bytes_of(self, result: Outcome, options: Mapping[str, Any]) -> int:
        """As `Files` says."""
        return self.sample_bytes(result.splats, options)

    def seen(
        self, result: Outcome, sh_degree: int, options: Mapping[str, Any]
    ) -> tuple[int, float, float]:
        """As `Files` says."""
        with self.clock.time("encode"):
            bare = result.splats.with_sh_degree(sh_degree)
            small, size = as_packed(bare, self.path, {**self.given, **options})
        with self.clock.time("measure"):
            judged = self.views.judge(small)
        return size, judged.psnr, judged.ssim
