"""Encoding results in memory, to measure their file size and their quality when read back."""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nanogs.clock import StageClock
from nanogs.frames import back, turned
from nanogs.io import derived_options, encoded_bytes, round_trip, round_trip_with_size
from nanogs.pipeline.outcome import Outcome
from nanogs.report import PackingReport
from nanogs.scoring.held_out import SelectionViews, selection_views
from nanogs.splats import Splats


@dataclass(eq=False)
class HeldFiles:
    """Encodes and measures results of a model in memory; see `size_request.Files`.

    Attributes:
        path: The output file; only its suffix counts.
        given: Options of its format that the user has chosen.
        original: The model.
        clock: Accumulates the seconds of each stage.
        frame: Source and target frame that results are turned from and to before encoding.
        by_psnr: Whether the goal is a PSNR, which is measured on automatic views alone.
    """

    path: Path
    given: Mapping[str, Any]
    original: Splats
    clock: StageClock
    frame: tuple[str, str] | None = None
    by_psnr: bool = False

    @cached_property
    def views(self) -> SelectionViews:
        """Renders of the original by which packings are chosen, on views not used for scoring."""
        return selection_views(self.original, automatic=self.by_psnr)

    def count(self, result: Outcome) -> int:
        """Return the number of splats of a result; see `Files.count`."""
        return len(result.splats)

    def sample_bytes(self, some: Splats, options: Mapping[str, Any]) -> int:
        """Return the bytes of a file of some splats; see `Files.sample_bytes`."""
        with self.clock.time("encode"):
            return encoded_bytes(turned(some, self.frame), self.path, {**self.given, **options})

    def bytes_of(self, result: Outcome, options: Mapping[str, Any]) -> int:
        """Return the bytes of a result's file; see `Files.bytes_of`."""
        return self.sample_bytes(result.splats, options)

    def shows(self) -> bool:
        """Return whether any view shows the original; see `Files.shows`."""
        with self.clock.time("measure"):
            return bool(self.views.kinds)

    def measure(self, result: Outcome, sh_degree: int, options: Mapping[str, Any]) -> PackingReport:
        """Encode a result and measure its bytes and quality; see `Files.measure`."""
        with self.clock.time("encode"):
            bare = turned(result.splats.with_sh_degree(sh_degree), self.frame)
            options = {**options, **derived_options(bare, self.path, {**self.given, **options})}
            small, size = round_trip_with_size(bare, self.path, {**self.given, **options})
        with self.clock.time("measure"):
            psnr, ssim = self.views.judge(turned(small, back(self.frame)))
        return PackingReport(sh_degree, options, len(bare), size, psnr, ssim)

    @contextmanager
    def stored(self, result: Outcome, options: Mapping[str, Any]) -> Iterator[Splats]:
        """Encode a result and read it back; see `Files.stored`."""
        given = {**self.given, **options}
        yield turned(
            round_trip(turned(result.splats, self.frame), self.path, given), back(self.frame)
        )

    def unwritten(self, result: Outcome) -> AbstractContextManager[Splats]:
        """Return the splats of a result, which are turned only when they are encoded."""
        return nullcontext(result.splats)
