"""The output folder of a run: rows as they are measured, then tables and plots."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from nanogs._version import __version__
from nanogs.bench.plot import plot
from nanogs.bench.rows import BenchRow, Status
from nanogs.bench.scenes import BenchScene
from nanogs.bench.settings import BenchSettings
from nanogs.bench.size_charts import SizeCharts
from nanogs.bench.size_tables import size_page
from nanogs.bench.tables import json_line, markdown
from nanogs.errors import ExistsError, OutputError
from nanogs.formatting import utf8
from nanogs.io.folder import make_folders, remove_empty

TABLE, LINES, PLOT = "results.md", "results.jsonl", "plot.svg"
PAGE, PICTURE = "results.html", "plot.png"  # only with file sizes
UNFINISHED = "unfinished.jsonl"  # first line: `run_of` of the run; then its rows so far


def run_of(scenes: Sequence[BenchScene], settings: BenchSettings) -> str:
    """Return all inputs of a run as one line of JSON, with size and mtime of the model files."""
    files = {str(scene.model): _stamp(scene.model) for scene in scenes}
    about = {
        "version": __version__,
        "files": files,
        "scenes": [asdict(scene) for scene in scenes],
        "settings": asdict(settings),
    }
    return json.dumps(about, default=str, sort_keys=True)


class ResultFolder:
    """A folder that saves rows as they are measured, so that an interrupted run can be resumed.

    Attributes:
        path: The folder.
        done: Rows measured by an unfinished run of the same scenes and settings.
    """

    def __init__(
        self, folder: str | Path, *, run: str | None = None, overwrite: bool = False
    ) -> None:
        """Create the folder, and refuse to replace results; nothing is overwritten yet.

        Args:
            folder: The folder; it is created if it is missing.
            run: From `run_of`; None for a run that is never resumed.
            overwrite: Replace existing results, also those of an unfinished run.

        Raises:
            OutputError: It holds results, also of an unfinished run of other scenes or settings, or
                cannot be created.
        """
        self.path, self.done = Path(folder), list[BenchRow]()
        self._run, self._begun = run, False
        for name in (TABLE, LINES, PLOT, PAGE, PICTURE):
            if (self.path / name).exists() and not overwrite:
                raise ExistsError(f"{self.path / name} exists already")
        with _writing(self.path):
            if not overwrite:
                self.done = self._rows_so_far()
            self._made = make_folders(self.path)

    def add(self, row: BenchRow) -> None:
        """Append a row to the unfinished run's file, unless the file has it from before.

        Raises:
            OutputError: It cannot be written.
        """
        unfinished = self.path / UNFINISHED
        with _writing(unfinished):
            if not self._begun:
                known = "".join(map(json_line, self.done))
                unfinished.write_text(f"{self._run or '{}'}\n{known}", encoding="utf-8")
            self._begun = True
            if row.key not in {known.key for known in self.done}:
                with unfinished.open("a", encoding="utf-8") as file:
                    file.write(json_line(row))

    def finish(
        self, rows: Sequence[BenchRow], preamble: str = "", others: Sequence[str] = ()
    ) -> None:
        """Write all rows, the preamble and tables, and the plot; with file sizes also a page.

        Args:
            rows: All rows of the run.
            preamble: How they were made, as Markdown.
            others: Anchors of the gains; see `gains.mean_gains`.

        Raises:
            OutputError: They cannot be written.
        """
        texts = {
            LINES: "".join(map(json_line, rows)),
            TABLE: preamble + markdown(rows, others=others),
            PLOT: plot(rows),
        }
        contents = {name: utf8(text) for name, text in texts.items()}
        if any(row.size is not None for row in rows):
            charts = SizeCharts(rows)
            contents[PLOT], contents[PICTURE] = utf8(charts.svg()), charts.png()
            contents[PAGE] = utf8(size_page(rows, others, preamble))
        for name, content in contents.items():
            with _writing(self.path / name):
                (self.path / name).write_bytes(content)
        with _writing(self.path / UNFINISHED):
            (self.path / UNFINISHED).unlink(missing_ok=True)

    def abandon(self) -> None:
        """Remove what was begun here, for a run that measured nothing.

        Raises:
            OutputError: It cannot be removed.
        """
        with _writing(self.path / UNFINISHED):
            if self._begun:
                (self.path / UNFINISHED).unlink(missing_ok=True)
        remove_empty(self._made)

    def _rows_so_far(self) -> list[BenchRow]:
        """Read the rows of an unfinished run; a last line that was cut off is dropped."""
        unfinished = self.path / UNFINISHED
        if not unfinished.exists():
            return []
        run, *lines = unfinished.read_text(encoding="utf-8").split("\n")
        if run != self._run:
            fact = f"{unfinished} belongs to an unfinished run of other models or settings"
            raise ExistsError(fact, "begin anew, or name another folder to keep it")
        rows = [BenchRow.from_dict(json.loads(line)) for line in lines[:-1]]
        return [row for row in rows if row.status is Status.OK]


def _stamp(path: Path) -> list[int]:
    """Return size and mtime (ns) of a file; an empty list if it cannot be accessed."""
    try:
        found = path.stat()
    except OSError:
        return []
    return [found.st_size, found.st_mtime_ns]


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error
