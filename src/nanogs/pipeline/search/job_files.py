"""Writes results of a job in blocks to files, and measures these; see `files`."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from nanogs.clock import StageClock
from nanogs.frames import back
from nanogs.io import (
    bytes_on_disk,
    derived_options,
    economical,
    write_model,
)
from nanogs.io import open as open_model
from nanogs.io.format import FormatOptions
from nanogs.io.rate_distortion import Curvatures
from nanogs.pipeline.job.result_writer import result_of
from nanogs.pipeline.job.rows import opened
from nanogs.pipeline.search.files import Files
from nanogs.pipeline.search.job_results import Result, Rounding
from nanogs.pipeline.search.latest import Latest
from nanogs.pipeline.search.size_request import Options
from nanogs.pipeline.tasks.parts import read_curvatures
from nanogs.pipeline.work import Work
from nanogs.report import PackingReport
from nanogs.scoring.held_out import SelectionViews, selection_views
from nanogs.sink import refuse_large
from nanogs.source import InMemory, Reduced, Source, turned_source
from nanogs.store.columns import row_bytes

TRIED = ".nanogs-tried"  # a file that is written to be measured; the job deletes it


def turned_back(source: Source, result: Result) -> Source:
    """Return a result, or its file, in the frame of the inputs."""
    return turned_source(source, back(result.work.settings.frame))


@dataclass(eq=False)
class JobFiles(Files[Result]):
    """Writes and measures results of a job; see `files.Files`.

    Attributes:
        output: Path of the result's file; those that are measured have its format.
        given: Options of the format that the caller gives.
        folder: Folder of the job, where files are written to be measured.
        max_memory: Bytes that this process may take; by default what is free.
        work: The job.
        clock: Gets the seconds of each stage.
    """

    output: Path
    given: FormatOptions
    folder: Path
    max_memory: int | None
    work: Work
    clock: StageClock
    _latest_curvatures: Latest[Curvatures | None] = field(default_factory=Latest)
    latest_filled: Latest[tuple[Result, int]] = field(default_factory=Latest)
    _unpacked: Latest[tuple[float, float]] = field(default_factory=Latest)

    @property
    def frame(self) -> tuple[str, str] | None:
        """Source and target frame of the job; see `Files.frame`."""
        return self.work.settings.frame

    @cached_property
    def views(self) -> SelectionViews:
        """The original on the views to choose by, which are not those that judge the result."""
        sought = self.work.settings.search
        by_psnr = sought is not None and sought.psnr is not None
        with self.open_original() as original:
            return selection_views(original, self.max_memory, automatic=by_psnr)

    def open_original(self) -> AbstractContextManager[Source]:
        """Open the model of the job; see `Files.open_original`."""
        return opened(self.work.settings, self.work.unpacked())

    def count(self, result: Result) -> int:
        """Return the number of splats of a result."""
        return result.work.target(result.level)

    def rounded(self, result: Result, options: Options, coarseness: float = 1.0) -> Result:
        """Return a result that is rounded when it is written; see `Files.rounded`."""
        return replace(result, rounding=Rounding(options, coarseness))

    def packed(self, result: Result, options: Options, coarseness: float) -> tuple[Result, int]:
        """Write a result that is rounded; return it and the bytes of its file."""
        made = self.rounded(result, options, coarseness)
        with (
            self.clock.time("encode"),
            result_of(made.work, made.level) as source,
            self.written(self.prepared(made, source), options) as path,
        ):
            return made, bytes_on_disk(path)

    def curvatures(self, result: Result) -> Curvatures | None:
        """Return how much a result's values show, if it may be held whole to be rounded."""
        sought, count = self.work.settings.search, self.count(result)
        fits = sought is None or sought.most is None or count <= sought.most
        if not fits or self.known.quantisation is None:
            return None
        work, level = result.work, result.level
        return self._latest_curvatures.of((level,), lambda: read_curvatures(work, level))

    def prepared(self, result: Result, source: Source) -> Source:
        """Return what is written of a result: itself, or its values as they are rounded.

        Args:
            result: The result.
            source: Its splats, in the frame that was asked for.
        """
        if result.rounding is None or (curvatures := self.curvatures(result)) is None:
            return source
        options, coarseness = result.rounding
        given = self.with_given(options)
        return InMemory(economical(source.load(), curvatures, self.output, given, coarseness))

    def measure(self, result: Result, sh_degree: int, options: Options) -> PackingReport:
        """Write a result to a file and measure it; see `Files.measure`."""
        with ExitStack() as opened_files:
            with self.clock.time("encode"):
                source = opened_files.enter_context(result_of(result.work, result.level))
                bare = Reduced(source, sh_degree)
                derived = derived_options(bare, self.output, self.with_given(options))
                options = {**options, **derived}
                path = opened_files.enter_context(self.written(bare, options))
                size = bytes_on_disk(path)
            file = opened_files.enter_context(open_model(path))
            with self.clock.time("measure"):
                found = self.views.judge(turned_back(file, result))
                before = self._unpacked.of(
                    (result, sh_degree), lambda: self.views.judge(turned_back(bare, result))
                )
        return PackingReport(sh_degree, options, self.count(result), size, *found, *before)

    @contextmanager
    def stored(self, result: Result, options: Options) -> Iterator[Source]:
        """Open a result as its file holds or shows it; see `Files.stored`."""
        with result_of(result.work, result.level) as source:
            if self.known.suffix == ".ply":  # the same values
                yield turned_back(source, result)
                return
            if self.known.shown is not None:
                self._refuse_large(source, options)
                yield turned_back(InMemory(self.known.shown(source.load())), result)
                return
            with (
                self.written(self.prepared(result, source), options) as path,
                open_model(path) as file,
            ):
                yield turned_back(file, result)

    @contextmanager
    def unwritten(self, result: Result) -> Iterator[Source]:
        """Open a result as it is in the files of the job; see `Files.unwritten`."""
        with result_of(result.work, result.level) as source:
            yield turned_back(source, result)

    @contextmanager
    def written(self, source: Source, options: Options) -> Iterator[Path]:
        """Write a file of a result, with further options of the format; delete it afterwards."""
        self._refuse_large(source, options)
        path = self.folder / f"{TRIED}{self.known.suffix}"
        try:
            write_model(source, path, overwrite=True, format_options=self.with_given(options))
            yield path
        finally:
            path.unlink(missing_ok=True)

    def _refuse_large(self, source: Source, options: Options) -> None:
        """Refuse a result whose file would have to be written from more memory than is allowed."""
        given = self.with_given(options)
        refuse_large(self.output, source.count, row_bytes(source.columns), self.max_memory, given)
