"""The end of a job: its files become results, which get their names when they are complete."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from nanogs.io import check_writable
from nanogs.io.format import FormatOptions
from nanogs.pipeline.folder import RESULT, refuse_finished
from nanogs.pipeline.result import move_into_place, seal, sealed, write_result
from nanogs.pipeline.run import Done
from nanogs.progress import Tracker


class Ending(Protocol):
    """Makes the results of a job whose tasks are done."""

    def check(self, folder: Path, *, resume: bool) -> None:
        """Look whether they can be written, before anything is begun.

        Args:
            folder: Of the job.
            resume: Whether one was to be continued, which is not there.

        Raises:
            OutputError: They cannot.
        """

    def check_begun(self, folder: Path) -> None:
        """Look whether those can be written that have not got their names yet.

        Raises:
            OutputError: They cannot.
        """

    def finish(self, done: Done, folder: Path, progress: Tracker) -> list[int]:
        """Make them in the job's folder and give them their names, unless a run before has.

        Returns:
            The splats of each.

        Raises:
            OutputError: They cannot be written.
        """


@dataclass(frozen=True, slots=True)
class Files:
    """A file for each level.

    Attributes:
        paths: The files to write.
        format_options: As `save` takes them.
        overwrite: Whether files that exist are replaced.
    """

    paths: tuple[Path, ...]
    format_options: FormatOptions | None
    overwrite: bool

    def check(self, folder: Path, *, resume: bool) -> None:
        """As `Ending` says."""
        for path in self.paths:
            if resume and not self.overwrite:
                refuse_finished(folder, path)
            check_writable(path, overwrite=self.overwrite, format_options=self.format_options)

    def check_begun(self, folder: Path) -> None:
        """As `Ending` says."""
        for level, path in enumerate(self.paths):
            if sealed(self._file(folder, level), path) is None:
                check_writable(path, overwrite=self.overwrite, format_options=self.format_options)

    def finish(self, done: Done, folder: Path, progress: Tracker) -> list[int]:
        """As `Ending` says."""
        return [self._finish(done, folder, level, progress) for level in range(len(self.paths))]

    def _finish(self, done: Done, folder: Path, level: int, progress: Tracker) -> int:
        """Write a result and give it its name, unless a run before has; the splats in it."""
        target = int(done.work.of_job("budget", level).facts["target"])
        path = self.paths[level]
        file = self._file(folder, level)
        progress.part(level, len(self.paths))
        count = sealed(file, path)
        if count is None:
            count = sealed(file, file)
            if count is None:
                count = write_result(done.work, level, file, target, self.format_options)
                seal(file, count)
            move_into_place(file, path, overwrite=self.overwrite)
        return count

    def _file(self, folder: Path, level: int) -> Path:
        """The file of a result until it gets its name."""
        return folder / f"{RESULT}{level}{''.join(self.paths[level].suffixes[-2:])}"
