"""The interface that writes results to measure their files, and that of a model in memory.

The one of a scene in blocks is in `in_blocks`.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol, TypeVar

from nanogs.clock import StageClock
from nanogs.frames import back, turned
from nanogs.io import derived_options, encoded_bytes, round_trip, round_trip_with_size
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.search.size_request import Options
from nanogs.report import PackingReport
from nanogs.scoring.held_out import SelectionViews, selection_views
from nanogs.source import Source
from nanogs.splats import Splats

R_contra = TypeVar("R_contra", contravariant=True)


class Files(Protocol[R_contra]):
    """Writes results to measure how large their files are, and how good they look.

    Attributes:
        clock: Gets the seconds of each stage.
    """

    clock: StageClock

    def open_original(self) -> AbstractContextManager[Splats | Source]:
        """Open the original, in its own frame."""

    def count(self, result: R_contra) -> int:
        """Return the number of splats of a result."""

    def sample_bytes(self, some: Splats, options: Options) -> int:
        """Return the size of a file of some splats with options of the format, bytes."""

    def bytes_of(self, result: R_contra, options: Options) -> int:
        """Return the size of a result's file, bytes."""

    def shows(self) -> bool:
        """Whether the views to choose by show the original, so that files can be compared."""

    def measure(self, result: R_contra, sh_degree: int, options: Options) -> PackingReport:
        """Write a result to a file; measure its bytes, and its quality on the views to choose by.

        Args:
            result: The result.
            sh_degree: Degree of the harmonics that are written, as far as the result has them.
            options: Of the format; the report also has those that are derived from the result.
        """

    def stored(self, result: R_contra, options: Options) -> AbstractContextManager[Splats | Source]:
        """Open a result as its file holds or shows it, in the frame of the original."""

    def unwritten(self, result: R_contra) -> AbstractContextManager[Splats | Source]:
        """Open a result as it is before it is written, in the frame of the original."""


@dataclass(eq=False)
class HeldFiles:
    """Encodes and measures results of a model in memory; see `Files`.

    Attributes:
        path: The output file; only its suffix counts.
        given: Options of its format that the user has chosen.
        original: The model.
        clock: Accumulates the seconds of each stage.
        frame: Source and target frame that results are turned from and to before encoding.
        by_psnr: Whether the goal is a PSNR, which is measured on automatic views alone.
    """

    path: Path
    given: Options
    original: Splats
    clock: StageClock
    frame: tuple[str, str] | None = None
    by_psnr: bool = False

    @cached_property
    def views(self) -> SelectionViews:
        """Renders of the original by which packings are chosen, on views not used for scoring."""
        return selection_views(self.original, automatic=self.by_psnr)

    def open_original(self) -> AbstractContextManager[Splats]:
        """Return the original, which is in memory."""
        return nullcontext(self.original)

    def count(self, result: Outcome) -> int:
        """Return the number of splats of a result; see `Files.count`."""
        return len(result.splats)

    def sample_bytes(self, some: Splats, options: Options) -> int:
        """Return the bytes of a file of some splats; see `Files.sample_bytes`."""
        with self.clock.time("encode"):
            return encoded_bytes(turned(some, self.frame), self.path, {**self.given, **options})

    def bytes_of(self, result: Outcome, options: Options) -> int:
        """Return the bytes of a result's file; see `Files.bytes_of`."""
        return self.sample_bytes(result.splats, options)

    def shows(self) -> bool:
        """Return whether any view shows the original; see `Files.shows`."""
        with self.clock.time("measure"):
            return bool(self.views.kinds)

    def measure(self, result: Outcome, sh_degree: int, options: Options) -> PackingReport:
        """Encode a result and measure its bytes and quality; see `Files.measure`."""
        with self.clock.time("encode"):
            bare = turned(result.splats.with_sh_degree(sh_degree), self.frame)
            options = {**options, **derived_options(bare, self.path, {**self.given, **options})}
            small, size = round_trip_with_size(bare, self.path, {**self.given, **options})
        with self.clock.time("measure"):
            psnr, ssim = self.views.judge(turned(small, back(self.frame)))
        return PackingReport(sh_degree, options, len(bare), size, psnr, ssim)

    @contextmanager
    def stored(self, result: Outcome, options: Options) -> Iterator[Splats]:
        """Encode a result and read it back; see `Files.stored`."""
        given = {**self.given, **options}
        yield turned(
            round_trip(turned(result.splats, self.frame), self.path, given), back(self.frame)
        )

    def unwritten(self, result: Outcome) -> AbstractContextManager[Splats]:
        """Return the splats of a result, which are turned only when they are encoded."""
        return nullcontext(result.splats)
