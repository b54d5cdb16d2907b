"""The search for the count of a job in blocks: results are made, written and measured."""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from nanogs.clock import StageClock
from nanogs.frames import back, turned
from nanogs.io import (
    bytes_on_disk,
    derived_options,
    economical,
    encoded_bytes,
    registry,
    write_model,
)
from nanogs.io import open as open_model
from nanogs.io.format import FormatOptions
from nanogs.io.rate_distortion import Curvatures
from nanogs.pipeline.job.result_writer import result_of
from nanogs.pipeline.job.rows import opened, sample
from nanogs.pipeline.options.presets import renders
from nanogs.pipeline.run import Done, Run
from nanogs.pipeline.search.file_size import SIZE_SAMPLE
from nanogs.pipeline.search.files import Files
from nanogs.pipeline.search.find import find_result
from nanogs.pipeline.search.job_results import JobResults, Result, Rounding
from nanogs.pipeline.search.latest import Latest
from nanogs.pipeline.search.size_request import SizeRequest
from nanogs.pipeline.tasks.parts import read_curvatures
from nanogs.pipeline.work import SHORT_RUN, Work
from nanogs.progress import Tracker
from nanogs.report import PackingReport
from nanogs.scoring.held_out import SelectionViews, selection_views
from nanogs.sink import refuse_large
from nanogs.source import InMemory, Reduced, Source, turned_source
from nanogs.splats import Splats
from nanogs.store.columns import row_bytes

TRIED = ".nanogs-tried"  # a file that is written to be measured; the job deletes it


def find_in_blocks(
    output: Path,
    options: FormatOptions | None,
    folder: Path,
    max_memory: int | None,
    work: Work,
    run: Run,
    progress: Tracker,
) -> Done:
    """Find the result of a job that meets its target; see `SearchTarget`.

    Args:
        output: Path of the file to be written.
        options: Of its format.
        folder: Folder of the job, where files are written to be measured.
        max_memory: Bytes that this process may take; by default what is free.
        work: The job; the stages before the results are done.
        run: Does its tasks.
        progress: Notified of each stage.

    Raises:
        TooSmallError: No result is as small as asked.
        OptionError: A result is too large to be written.
        ModelError: A PSNR or a draw cost is asked of a model that shows nothing.
    """
    settings, sought = work.settings, work.settings.search
    assert sought is not None  # noqa: S101 - a search has a target
    goal, known, given = sought.goal, registry.writable(output), options or {}
    looks = renders(settings.parameters)
    request = SizeRequest(
        goal.size or 0, known, given, settings.sh_degree, looks=looks, most=sought.most
    )
    results = JobResults(work, run, settings)
    files = JobFiles(output, given, folder, max_memory, work, run.clock)
    result, fields, notes = find_result(
        goal, request, lambda: results, partial(_sample, work), files, progress, max_memory
    )
    prepared = partial(files.prepared, result)
    return Done(result.work, run.kept, (result.level,), fields, notes, prepared)


def _sample(work: Work) -> Splats:
    return sample(work.settings, work.unpacked(), rows=SIZE_SAMPLE, span=SHORT_RUN, bare=False)


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
    _shown: Latest[Curvatures | None] = field(default_factory=Latest)
    latest_filled: Latest[tuple[Result, int]] = field(default_factory=Latest)
    _unpacked: Latest[tuple[float, float]] = field(default_factory=Latest)

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

    def rounded(self, result: Result, options: Mapping[str, Any]) -> Result:
        """Return a result that is rounded when it is written; see `Files.rounded`."""
        return replace(result, rounding=Rounding(options, 1.0))

    def packed(
        self, result: Result, options: Mapping[str, Any], coarseness: float
    ) -> tuple[Result, int]:
        """Write a result that is rounded; return it and the bytes of its file."""
        made = replace(result, rounding=Rounding(options, coarseness))
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
        quantises = registry.writable(self.output).quantisation is not None
        if not (fits and quantises):
            return None
        return self._shown.of((result.level,), lambda: read_curvatures(result.work, result.level))

    def prepared(self, result: Result, source: Source) -> Source:
        """Return what is written of a result: itself, or its values as they are rounded.

        Args:
            result: The result.
            source: Its splats, in the frame that was asked for.
        """
        if result.rounding is None or (curvatures := self.curvatures(result)) is None:
            return source
        options, coarseness = result.rounding
        given = {**self.given, **options}
        return InMemory(economical(source.load(), curvatures, self.output, given, coarseness))

    def sample_bytes(self, some: Splats, options: Mapping[str, Any]) -> int:
        """Return the size of a file of some splats, bytes, in the frame that was asked for."""
        given, frame = {**self.given, **options}, self.work.settings.frame
        with self.clock.time("encode"):
            return encoded_bytes(turned(some, frame), self.output, given)

    def shows(self) -> bool:
        """Whether the views to choose by show the original."""
        with self.clock.time("measure"):
            return bool(self.views.kinds)

    def measure(self, result: Result, sh_degree: int, options: Mapping[str, Any]) -> PackingReport:
        """Write a result to a file and measure it; see `Files.measure`."""
        with ExitStack() as opened_files:
            with self.clock.time("encode"):
                source = opened_files.enter_context(result_of(result.work, result.level))
                bare = Reduced(source, sh_degree)
                given = {**self.given, **options}
                options = {**options, **derived_options(bare, self.output, given)}
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
    def stored(self, result: Result, options: Mapping[str, Any]) -> Iterator[Source]:
        """Open a result as its file holds or shows it; see `Files.stored`."""
        known = registry.writable(self.output)
        with result_of(result.work, result.level) as source:
            if known.suffix == ".ply":
                yield turned_back(source, result)
                return
            if known.shown is not None:
                self._refuse_large(source, options)
                yield turned_back(InMemory(known.shown(source.load())), result)
                return
            small = self.prepared(self.rounded(result, options), source)
            with self.written(small, options) as path, open_model(path) as file:
                yield turned_back(file, result)

    @contextmanager
    def unwritten(self, result: Result) -> Iterator[Source]:
        """Open a result as it is in the files of the job; see `Files.unwritten`."""
        with result_of(result.work, result.level) as source:
            yield turned_back(source, result)

    @contextmanager
    def written(self, source: Source, options: Mapping[str, Any]) -> Iterator[Path]:
        """Write a file of a result, with further options of the format; delete it afterwards."""
        self._refuse_large(source, options)
        path = self.folder / f"{TRIED}{registry.writable(self.output).suffix}"
        given = {**self.given, **options}
        try:
            write_model(source, path, overwrite=True, format_options=given)
            yield path
        finally:
            path.unlink(missing_ok=True)

    def _refuse_large(self, source: Source, options: Mapping[str, Any]) -> None:
        """Refuse a result whose file would have to be written from more memory than is allowed."""
        row, given = row_bytes(source.columns), {**self.given, **options}
        refuse_large(self.output, source.count, row, self.max_memory, given)
