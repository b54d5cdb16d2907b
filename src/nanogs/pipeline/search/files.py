"""The interface that writes results to measure their files, and that of a model in memory.

The one of a scene in blocks is in `job_files`.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

from nanogs.clock import StageClock
from nanogs.frames import back, turned
from nanogs.io import (
    derived_options,
    encoded_bytes,
    registry,
    round_trip,
    round_trip_with_size,
)
from nanogs.io.format import Format
from nanogs.io.rate_distortion import Curvatures
from nanogs.pipeline.outcome import Outcome
from nanogs.pipeline.rounded import rounded
from nanogs.pipeline.search.coarseness import FINEST, fill_by_rounding
from nanogs.pipeline.search.file_size import ENOUGH
from nanogs.pipeline.search.latest import Latest
from nanogs.pipeline.search.size_request import Options
from nanogs.report import PackingReport
from nanogs.scoring.held_out import SelectionViews, selection_views
from nanogs.source import Source
from nanogs.splats import Splats

R = TypeVar("R")


class Files(Protocol[R]):
    """Writes results to measure how large their files are, and how good they look.

    Attributes:
        output: Path of the output file; files that are measured have its format.
        given: Options of the format that the user has chosen.
        clock: Gets the seconds of each stage.
        latest_filled: The latest result that was rounded to fill a size, and its bytes.
    """

    output: Path
    given: Options
    clock: StageClock
    latest_filled: Latest[tuple[R, int]]

    @property
    def known(self) -> Format:
        """The format of the files."""
        return registry.writable(self.output)

    @property
    def frame(self) -> tuple[str, str] | None:
        """Source and target frame that splats are turned from and to before encoding."""

    @property
    def views(self) -> SelectionViews:
        """The original on the views to choose by, which are not those that judge the result."""

    def with_given(self, options: Options) -> dict[str, Any]:
        """Return options of the format together with those that the user has chosen."""
        return {**self.given, **options}

    def open_original(self) -> AbstractContextManager[Splats | Source]:
        """Open the original, in its own frame."""

    def count(self, result: R) -> int:
        """Return the number of splats of a result."""

    def rounded(self, result: R, options: Options, coarseness: float = 1.0) -> R:
        """Return a result whose values are rounded so that its file packs well.

        It is returned itself if it was not fitted. The arguments are those of `bytes_of`.
        """

    def curvatures(self, result: R) -> Curvatures | None:
        """Return how much a result's values show, if they are rounded by it."""

    def packed(self, result: R, options: Options, coarseness: float) -> tuple[R, int]:
        """Return a result that is rounded with a coarseness, and the bytes of its file."""

    def filled(
        self, result: R, options: Options, size: int, coarseness: float = 1.0
    ) -> tuple[R, int]:
        """Return a result that is delivered, rounded so that its file fills a size, and its bytes.

        If usual rounding leaves room, which no more splats can fill, values are rounded as finely
        as fills it. The arguments are those of `bytes_of`.
        """
        found = self._filling(result, options, size, coarseness)
        if found[1] >= ENOUGH * size:
            return found
        return fill_by_rounding(self._packed_by(result, options, coarseness), size, FINEST)

    def bytes_of(
        self, result: R, options: Options, size: int | None = None, coarseness: float = 1.0
    ) -> int:
        """Return the size of a result's file, rounded as by `rounded`, bytes.

        Args:
            result: The result.
            options: Of the format.
            size: Bytes to fill by rounding somewhat more finely or coarsely.
            coarseness: Of rounding; see `packed`.
        """
        if size is None or self.curvatures(result) is None:
            return self.packed(result, options, coarseness)[1]
        return self._filling(result, options, size, coarseness)[1]

    def _filling(self, result: R, options: Options, size: int, coarseness: float) -> tuple[R, int]:
        """Return a result whose rounding fills a size, and its bytes."""
        packed = self._packed_by(result, options, coarseness)
        return self.latest_filled.of(
            (result, options, size, coarseness), lambda: fill_by_rounding(packed, size)
        )

    def _packed_by(
        self, result: R, options: Options, coarseness: float
    ) -> Callable[[float], tuple[R, int]]:
        """Return a function that packs a result with a factor of a coarseness."""
        return lambda factor: self.packed(result, options, factor * coarseness)

    def sample_bytes(self, some: Splats, options: Options) -> int:
        """Return the size of a file of some splats with options of the format, bytes."""
        with self.clock.time("encode"):
            return encoded_bytes(turned(some, self.frame), self.output, self.with_given(options))

    def shows(self) -> bool:
        """Whether the views to choose by show the original, so that files can be compared."""
        with self.clock.time("measure"):
            return bool(self.views.kinds)

    def measure(self, result: R, sh_degree: int, options: Options) -> PackingReport:
        """Write a result to a file; measure its bytes, and its quality on the views to choose by.

        Values are rounded to the nearest: results that are only compared are fitted to so few views
        that these do not tell well what shows.

        Args:
            result: The result.
            sh_degree: Degree of the harmonics that are written, as far as the result has them.
            options: Of the format; the report also has those that are derived from the result.
        """

    def stored(self, result: R, options: Options) -> AbstractContextManager[Splats | Source]:
        """Open a result, rounded or not, as its file holds or shows it, in the original's frame."""

    def unwritten(self, result: R) -> AbstractContextManager[Splats | Source]:
        """Open a result as it is before it is written, in the frame of the original."""


@dataclass(eq=False)
class HeldFiles(Files[Outcome]):
    """Encodes and measures results of a model in memory; see `Files`.

    Attributes:
        output: Path of the output file, of which only the suffix counts.
        given: Options of its format that the user has chosen.
        original: The model.
        clock: Accumulates the seconds of each stage.
        frame: Source and target frame that results are turned from and to before encoding.
        by_psnr: Whether the goal is a PSNR, which is measured on automatic views alone.
    """

    output: Path
    given: Options
    original: Splats
    clock: StageClock
    frame: tuple[str, str] | None = None
    by_psnr: bool = False
    latest_filled: Latest[tuple[Outcome, int]] = field(default_factory=Latest)
    _unpacked: Latest[tuple[float, float]] = field(default_factory=Latest)

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

    def rounded(self, result: Outcome, options: Options, coarseness: float = 1.0) -> Outcome:
        """Return a result whose values are rounded to pack well; see `Files.rounded`."""
        if self.curvatures(result) is None:
            return result
        with self.clock.time("encode"):
            given = self.with_given(options)
            return rounded(result, self.output, given, self.frame, coarseness)

    def curvatures(self, result: Outcome) -> Curvatures | None:
        """Return how much a result's values show; see `Files.curvatures`."""
        return result.curvatures if self.known.quantisation else None

    def packed(self, result: Outcome, options: Options, coarseness: float) -> tuple[Outcome, int]:
        """Return a rounded result and the bytes of its file; see `Files.packed`."""
        small = self.rounded(result, options, coarseness)
        return small, self.sample_bytes(small.splats, options)

    def measure(self, result: Outcome, sh_degree: int, options: Options) -> PackingReport:
        """Encode a result and measure its bytes and quality; see `Files.measure`."""
        with self.clock.time("encode"):
            bare = turned(result.splats.with_sh_degree(sh_degree), self.frame)
            options = {**options, **derived_options(bare, self.output, self.with_given(options))}
            small, size = round_trip_with_size(bare, self.output, self.with_given(options))
        with self.clock.time("measure"):
            found = self.views.judge(turned(small, back(self.frame)))
            before = self._unpacked.of(
                (result, sh_degree),
                lambda: self.views.judge(result.splats.with_sh_degree(sh_degree)),
            )
        return PackingReport(sh_degree, options, len(bare), size, *found, *before)

    @contextmanager
    def stored(self, result: Outcome, options: Options) -> Iterator[Splats]:
        """Encode a result and read it back; see `Files.stored`."""
        small = turned(result.splats, self.frame)
        yield turned(round_trip(small, self.output, self.with_given(options)), back(self.frame))

    def unwritten(self, result: Outcome) -> AbstractContextManager[Splats]:
        """Return the splats of a result, which are turned only when they are encoded."""
        return nullcontext(result.splats)
