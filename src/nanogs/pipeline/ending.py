"""The end of a job: its files become results, which get their name when they are complete.

They are made in the job's folder and then moved. A run that is killed between any two of its steps
finds out what was done by checksums.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from nanogs.block_layouts import Chunked, Linked
from nanogs.io.atomic import atomic_write, output_error
from nanogs.pipeline.chunked import blocks_of
from nanogs.pipeline.folder import RESULT, refuse_finished
from nanogs.pipeline.linked import even_sample, linked_levels, trees_of
from nanogs.pipeline.parts import LevelSource, simplify_further
from nanogs.pipeline.rows import opened
from nanogs.pipeline.run import Done
from nanogs.pipeline.work import Work
from nanogs.progress import Parts, Tracker, untold
from nanogs.report import SimplifyReport
from nanogs.scoring.file_judge import FileJudge, file_costs, file_judge
from nanogs.sink import Sink, Written
from nanogs.source import InMemory, Joined, Source, Turned
from nanogs.store.scratch import hash_file

Tell = Callable[[Done, Sequence[Written]], list[SimplifyReport]]
"""Makes the report of each result."""


@dataclass(frozen=True, slots=True)
class Ending:
    """Makes the results of a job whose tasks are done.

    Attributes:
        sink: Where they go.
        reports: Makes the report of each result.
        measured: Whether each is held against the model.
        costed: Whether it is said what each takes to draw.
        max_memory: Bytes that this process may take for that; by default what is free.
    """

    sink: Sink
    reports: Tell
    measured: bool = False
    max_memory: int | None = None
    costed: bool = False

    def check(self, folder: Path, *, resume: bool) -> None:
        """Look whether they can be written, before anything is begun.

        Args:
            folder: Of the job.
            resume: Whether one was to be continued, which is not there.

        Raises:
            OutputError: They cannot.
        """
        if resume and not self.sink.overwrite:
            refuse_finished(folder, self.sink.place)
        self.sink.check()

    def check_begun(self, folder: Path) -> None:
        """Look whether those can be written that have not got their name yet.

        Raises:
            OutputError: They cannot.
        """
        if self._sealed(self._made(folder), self.sink.place) is None:
            self.sink.check()

    def finish(self, done: Done, folder: Path, progress: Tracker) -> list[Written]:
        """Make them in the job's folder and give them their name, unless a run before has.

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
            filling, work = self.sink.open(made, done.entries.get("format_options", {})), done.work
            tell: Parts = progress.part
            if isinstance(self.sink.chunks, Linked) and (levels := linked_levels(work)):
                filling.add_trees(trees_of(work), levels, even_sample(work), tell)
                tell = untold  # all is written in the end
            for number, level in enumerate(done.levels):
                if not isinstance(self.sink.chunks, Chunked):
                    tell(number, len(done.levels))
                    with result_of(work, level) as source:
                        filling.add(source)
                else:
                    filling.add_blocks(blocks_of(work, level, progress.part))
            with self._judge(work, progress) as judge:
                filling.finish(self.reports(done, filling.written), judge)
            if self.costed and judge is None:  # its PSNR is known already
                filling.written[0] = self._costed(work, filling.written[0], made)
            _seal(made, self.sink.files(made), filling.written, measured=self.measured)
        except OSError as error:
            raise output_error(made, error) from error
        return filling.written

    @contextmanager
    def _judge(self, work: Work, progress: Tracker) -> Iterator[FileJudge | None]:
        """Yield a judge of files while the model is open; None where nothing is measured."""
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
                tell=progress.part, max_memory=self.max_memory, costs=self.costed,
            )  # fmt: skip

    def _costed(self, work: Work, written: Written, made: Path) -> Written:
        settings = work.settings
        with opened(settings, work.unpacked()) as original:
            costs = file_costs(original, made, settings.frame, work.threads)
        return written._replace(costs=[each.numbers for each in costs] or None)

    def _sealed(self, made: Path, place: Path) -> list[Written] | None:
        """The results as sealed, if the files at a place are these; else None."""
        with suppress(OSError, ValueError, LookupError, TypeError):
            note = json.loads(_note(made).read_bytes())
            files = note["files"]
            if note["measured"] is self.measured and all(
                (place / name).stat().st_size == size for name, size in files.items()
            ):
                with (place / next(iter(files))).open("rb") as file:
                    if [*hash_file(file)] == note["first"]:
                        return [Written(*each) for each in note["written"]]
        return None

    def _made(self, folder: Path) -> Path:
        """The place of results until they get their name."""
        return folder / f"{RESULT}made{''.join(self.sink.place.suffixes[-2:])}"


@contextmanager
def result_of(work: Work, level: int) -> Iterator[Source]:
    """The result of a level, in the frame that was asked for.

    Where blocks could not go as far as asked, the rest is done in memory.

    Args:
        work: The job, all its tasks done.
        level: Of the result.
    """
    target = work.target(level)
    with LevelSource(work, level) as parts:
        source: Source = parts
        if parts.count > target:
            source = InMemory(simplify_further(parts.load(), target, work.settings, work.threads))
        yield source if work.settings.frame is None else Turned(source, *work.settings.frame)


def _seal(made: Path, files: Sequence[str], written: Sequence[Written], *, measured: bool) -> None:
    """Note what results are, beside them, so that they are known again under another name."""
    sizes = {name: (made / name).stat().st_size for name in files}
    with (made / files[0]).open("rb") as file:
        first = hash_file(file)
    note = {"files": sizes, "first": first, "written": written, "measured": measured}
    with atomic_write(_note(made), overwrite=True) as out:
        out.write(json.dumps(note).encode())


def _note(made: Path) -> Path:
    return made.with_name(f"{made.name}.json")
