"""The search for the count of a job in blocks, by the files that its results make."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from nanogs.clock import StageClock
from nanogs.io import bytes_on_disk, encoded_bytes, registry, save
from nanogs.io import open as open_model
from nanogs.io.format import FormatOptions
from nanogs.pipeline.ending import result_of
from nanogs.pipeline.fit_size import SAMPLE, WHOLE_FITS, fit_size, guess_count
from nanogs.pipeline.job_results import JobResults, Result
from nanogs.pipeline.reach import reach_psnr
from nanogs.pipeline.rows import opened, sample
from nanogs.pipeline.run import Done, Run
from nanogs.pipeline.work import SPAN, Work
from nanogs.progress import Tracker
from nanogs.scoring.held_out import held_out
from nanogs.sink import refuse_large
from nanogs.source import Source, Turned
from nanogs.store.columns import row_bytes

TRIED = ".nanogs-tried"  # a file that is written to be measured; the job takes it away


class _Found(NamedTuple):
    """A result, the entries of its report, and what else there is to say."""

    result: Result
    entries: Mapping[str, Any]
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Search:
    """Looks for the count of a result in blocks; see `Sought`.

    Attributes:
        output: What is going to be written.
        options: Of its format.
        folder: Of the job, where files are written to be measured.
        max_memory: Bytes that this process may take; by default what is free.
    """

    output: Path
    options: FormatOptions | None
    folder: Path
    max_memory: int | None

    def find(self, work: Work, run: Run, progress: Tracker) -> Done:
        """The result that meets what is sought.

        Args:
            work: The job; what is done once is done.
            run: Does its tasks.
            progress: Told of each stage.

        Raises:
            TooSmallError: No result is as small as is asked.
            OptionError: A result is too large to be written.
            ModelError: A PSNR is sought of a model that shows nothing.
        """
        results, sought = JobResults.of(work, run), work.settings.search
        assert sought is not None  # noqa: S101 - or there is no search
        if sought.psnr is not None:
            found = self._reach(results, sought.psnr, run.clock, progress)
        else:
            found = self._fit(results, sought.size or 0, run.clock, progress)
        result, entries, notes = found
        return Done(result.work, run.kept, (result.level,), entries, notes)

    def _reach(
        self, results: JobResults, psnr: float, clock: StageClock, progress: Tracker
    ) -> _Found:
        work = results.work
        progress.begin("measure")
        with clock.time("measure"), opened(work.settings, work.unpacked()) as original:
            views = held_out(original, progress.part, self.max_memory)

        def psnr_of(result: Result) -> float:
            with clock.time("measure"), self._stored(result) as small:
                return views.psnr(small)

        result, found = reach_psnr(results, psnr, psnr_of, progress)
        results.verify(result, progress)
        with clock.time("measure"), self._stored(result) as small:
            judged = views.judge(small)
        return _Found(result, {"probes": found.probes, "stop": found.stop, "judged": judged})

    def _fit(self, results: JobResults, size: int, clock: StageClock, progress: Tracker) -> _Found:
        def bytes_of(result: Result) -> int:
            with (
                clock.time("encode"),
                result_of(result.work, result.level) as source,
                self._written(source) as path,
            ):
                return bytes_on_disk(path)

        progress.begin("guess")
        work = results.work
        some = sample(work.settings, work.unpacked(), rows=SAMPLE, span=SPAN, bare=False)
        encode = partial(encoded_bytes, path=self.output, format_options=self.options)
        with clock.time("encode"):
            guess = guess_count(some, results.available, size, encode)
        result, found = fit_size(results, size, guess, bytes_of, progress)
        results.verify(result, progress)
        notes = found.leap(size, results.available)
        if found.count == results.available:
            notes += (WHOLE_FITS,)
        return _Found(result, {"achieved_size": found.bytes, "size_probes": found.probes}, notes)

    @contextmanager
    def _stored(self, result: Result) -> Iterator[Source]:
        """A result as its file gives it back, in the frame of the inputs."""
        known, frame = registry.writable(self.output), result.work.settings.frame

        def back(source: Source) -> Source:
            return Turned(source, frame[1], frame[0]) if frame else source

        with result_of(result.work, result.level) as source:
            if known.suffix == ".ply" or not known.readable:
                yield back(source)
                return
            with self._written(source) as path, open_model(path) as file:
                yield back(file)

    @contextmanager
    def _written(self, source: Source) -> Iterator[Path]:
        """A file of a result, which is taken away afterwards."""
        refuse_large(self.output, source.count, row_bytes(source.columns), self.max_memory)
        path = self.folder / f"{TRIED}{registry.writable(self.output).suffix}"
        save(source, path, overwrite=True, format_options=self.options)
        yield path
        path.unlink()
