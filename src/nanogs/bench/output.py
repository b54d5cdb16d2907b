"""Results as files in a folder."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nanogs.bench.plot import save_plot
from nanogs.bench.rows import BenchRow
from nanogs.bench.tables import json_line, markdown
from nanogs.errors import OutputError

TABLE, LINES, PLOT = "results.md", "results.jsonl", "plot.png"


class ResultFolder:
    """A folder that takes rows as they come, so that a run that ends early leaves what it has."""

    def __init__(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Make the folder, and refuse to replace results; nothing is replaced yet.

        Args:
            folder: The folder; it is made where it is missing.
            overwrite: Replace results that are there.

        Raises:
            OutputError: It holds results, or cannot be made.
        """
        self.path = Path(folder)
        self._begun = False
        for name in (TABLE, LINES, PLOT):
            if (self.path / name).exists() and not overwrite:
                raise OutputError(f"{self.path / name} exists; -w replaces it.")
        with _writing(self.path):
            self.path.mkdir(parents=True, exist_ok=True)

    def add(self, row: BenchRow) -> None:
        """Append a row to the JSON lines.

        Raises:
            OutputError: It cannot be written.
        """
        lines = self.path / LINES
        with _writing(lines), lines.open("a" if self._begun else "w", encoding="utf-8") as file:
            file.write(json_line(row))
        self._begun = True

    def finish(self, rows: Sequence[BenchRow], preamble: str = "") -> None:
        """Write the table, below a preamble, and the plot.

        Raises:
            OutputError: They cannot be written.
        """
        table = self.path / TABLE
        with _writing(table):
            table.write_text(preamble + markdown(rows), encoding="utf-8")
        with _writing(self.path / PLOT):
            save_plot(rows, self.path / PLOT)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error
