"""The end of a job: results are written in the job's folder and, when complete, moved into place.

If a run is killed between any two of these steps, the next run finds out by checksums which were
done.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nanogs.block_layouts import Chunked, Linked
from nanogs.io import economical, registry
from nanogs.io.atomic import atomic_write, output_error
from nanogs.io.format import options_text
from nanogs.pipeline.job.folder import RESULT, refuse_finished
from nanogs.pipeline.job.rows import opened
from nanogs.pipeline.run import Done
from nanogs.pipeline.tasks.chunked import blocks_of
from nanogs.pipeline.tasks.linked import even_sample, linked_levels, trees_of
from nanogs.pipeline.tasks.parts import LevelSource, read_curvatures, simplify_further
from nanogs.pipeline.work import Work
from nanogs.progress import PartProgress, Tracker, ignore_progress
from nanogs.report import SimplifyReport
from nanogs.scoring.file_judge import FileJudge, file_costs, file_judge
from nanogs.sink import Sink, Written
from nanogs.source import InMemory, Joined, Source, turned_source
from nanogs.store.scratch import hash_file

MakeReports = Callable[[Done, Sequence[Written]], list[SimplifyReport]]
"""Makes a report for each result that was written."""


@dataclass(frozen=True, slots=True)
class ResultWriter:
    """Writes the results of a job whose tasks are done.

    Attributes:
        sink: Destination of the results.
        reports: Makes the report of each result.
        measured: Whether each result is compared with the model.
        costed: Whether the draw cost of each result is measured.
        max_memory: Bytes that this process may take for that; by default what is free.
    """

    sink: Sink
    reports: MakeReports
    measured: bool = False
    max_memory: int | None = None
    costed: bool = False

    def check(self, folder: Path, *, resume: bool) -> None:
        """Check that the results can be written, before a new job is begun.

        Args:
            folder: The job's folder.
            resume: Whether the caller asked to resume a job, and there is none.

        Raises:
            OutputError: They cannot be written.
        """
        if resume and not self.sink.overwrite:
            refuse_finished(folder, self.sink.place)
        self.sink.check()

    def check_begun(self, folder: Path) -> None:
        """Check that the results of a resumed job can be written, unless they are in place.

        Raises:
            OutputError: They cannot be written.
        """
        if self._sealed(self._made(folder), self.sink.place) is None:
            self.sink.check()

    def finish(self, done: Done, folder: Path, progress: Tracker) -> list[Written]:
        """Write the results in the job's folder and move them, unless an earlier run has.

        Raises:
            OutputError: They cannot be written.
        """
        made = self._made(folder)
        written = self._sealed(made, self.sink.place)
        if written is None:
            written = self._sealed(made, made)
            if written is None:
                written = self._make(done, made, progress)
            self.sink.move(made)
        return written

    def _make(self, done: Done, made: Path, progress: Tracker) -> list[Written]:
        try:
            filling, work = self.sink.open(made, done.fields.get("format_options", {})), done.work
            on_progress: PartProgress = progress.part
            if isinstance(self.sink.block_layout, Linked) and (levels := linked_levels(work)):
                filling.add_trees(trees_of(work), levels, even_sample(work), on_progress)
                # `finish` writes everything, and reports the progress itself.
                on_progress = ignore_progress
            for number, level in enumerate(done.levels):
                if not isinstance(self.sink.block_layout, Chunked):
                    on_progress(number, len(done.levels))
                    with result_of(work, level) as source:
                        filling.add(self._prepared(done, level, source))
                else:
                    filling.add_blocks(blocks_of(work, level, progress.part))
            with self._judge(work, progress) as judge:
                filling.finish(self.reports(done, filling.written), judge)
            if self.costed and judge is None:  # not measured here: its PSNR is known already
                filling.written[0] = self._costed(work, filling.written[0], made)
            _seal(made, self.sink.files(made), filling.written, self._choices)
        except OSError as error:
            raise output_error(made, error) from error
        return filling.written

    def _prepared(self, done: Done, level: int, source: Source) -> Source:
        """Return what is written of a result: itself, or with values that pack well."""
        curvatures = read_curvatures(done.work, level) if done.work.settings.rounded else None
        if curvatures is None:
            return done.prepared(source)
        path, given = registry.file_of(self.sink.suffix), self.sink.format_options or {}
        return InMemory(economical(source.load(), curvatures, path, given))

    @contextmanager
    def _judge(self, work: Work, progress: Tracker) -> Iterator[FileJudge | None]:
        """Open the model and yield a judge of result files; None if nothing is measured."""
        if not self.measured:
            yield None
            return
        settings = work.settings
        progress.begin("measure")
        with opened(settings, work.unpacked()) as scene:
            beside, original = self.sink.environment, scene
            if beside is not None:
                original = Joined([scene, InMemory(beside.original())])
            yield file_judge(
                original, self.sink.suffix, turn=settings.frame, threads=work.threads,
                on_progress=progress.part, max_memory=self.max_memory, costs=self.costed,
            )  # fmt: skip

    def _costed(self, work: Work, written: Written, made: Path) -> Written:
        settings = work.settings
        with opened(settings, work.unpacked()) as original:
            costs = file_costs(original, made, settings.frame, work.threads)
        return written._replace(costs=[each.numbers for each in costs] or None)

    def _sealed(self, made: Path, place: Path) -> list[Written] | None:
        """Return the results noted by `_seal` if the files at `place` match the note, else None."""
        with suppress(OSError, ValueError, LookupError, TypeError):
            note = json.loads(_note(made).read_bytes())
            files = note["files"]
            if note["choices"] == self._choices and all(
                (place / name).stat().st_size == size for name, size in files.items()
            ):
                with (place / next(iter(files))).open("rb") as file:
                    if [*hash_file(file)] == note["first"]:
                        return [Written(*each) for each in note["written"]]
        return None

    @property
    def _choices(self) -> dict[str, Any]:
        """The choices that results depend on besides the settings of the job, as plain data."""
        return {
            "suffix": self.sink.suffix,
            "format_options": options_text(self.sink.format_options),
            "measured": self.measured,
            "costed": self.costed,
        }

    def _made(self, folder: Path) -> Path:
        """Return the path in the job's folder where the results are until they are moved."""
        return folder / f"{RESULT}{''.join(self.sink.place.suffixes[-2:])}"


@contextmanager
def result_of(work: Work, level: int) -> Iterator[Source]:
    """Open the result of a level, in the frame that was asked for.

    If the blocks could not be merged to the count asked for, the rest is merged in memory.

    Args:
        work: The job; all its tasks are done.
        level: Number of the level.
    """
    target = work.target(level)
    with LevelSource(work, level) as parts:
        source: Source = parts
        if parts.count > target:
            source = InMemory(simplify_further(parts.load(), target, work.settings, work.threads))
        yield turned_source(source, work.settings.frame)


def _seal(
    made: Path, files: Sequence[str], written: Sequence[Written], choices: Mapping[str, Any]
) -> None:
    """Write a note with file sizes and a checksum, by which moved results are recognised."""
    sizes = {name: (made / name).stat().st_size for name in files}
    with (made / files[0]).open("rb") as file:
        first = hash_file(file)
    note = {"files": sizes, "first": first, "written": written, "choices": choices}
    with atomic_write(_note(made), overwrite=True) as out:
        out.write(json.dumps(note).encode())


def _note(made: Path) -> Path:
    return made.with_name(f"{made.name}.json")
