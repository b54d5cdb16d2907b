"""The output folder of a run: rows as they are measured, then tables and plots."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from nanogs._version import __version__
from nanogs.bench.digest import digest_of_sources
from nanogs.bench.measuring import external_path, note_of
from nanogs.bench.plot import plot
from nanogs.bench.rows import BenchRow, BenchTarget, RowKey, Status
from nanogs.bench.run import row_keys
from nanogs.bench.scenes import BenchScene
from nanogs.bench.settings import BenchSettings
from nanogs.bench.size_charts import SizeCharts
from nanogs.bench.size_tables import size_page
from nanogs.bench.tables import json_line, markdown
from nanogs.cleanup import cleaned_up
from nanogs.datasets.dataset import open_dataset
from nanogs.errors import ExistsError, NanogsError, OutputError
from nanogs.formatting import utf8
from nanogs.io.atomic import atomic_write, writing
from nanogs.io.folder import make_folders, remove_empty
from nanogs.io.temporary import locked

TABLE, LINES, PLOT = "results.md", "results.jsonl", "plot.svg"
PAGE, PICTURE = "results.html", "plot.png"  # only with file sizes
RUN = "run.json"  # `run_of` of the finished run
UNFINISHED = "unfinished.jsonl"  # first line: `run_of` of the run; then its rows so far
_APART = ("cli", "view", "lod", "studio")  # packages that affect neither results nor scores
_OTHER = "another version, other models, photographs or settings"
# Settings that say which rows there are, and nothing of how each is measured.
_ASKED = ("ratios", "methods", "externals", "file_sizes", "formats")


def run_of(scenes: Sequence[BenchScene], settings: BenchSettings) -> str:
    """Return all inputs of a run as one line of JSON, with size and mtime of the files it reads.

    These are the models, their cameras and photographs, and the files of other tools, each beside
    the row that it is scored for. The version has a digest of the sources: clones share the number.
    """
    measured = {name: value for name, value in asdict(settings).items() if name not in _ASKED}
    about = {
        "version": f"{__version__} {digest_of_sources(_APART)}",
        "settings": measured,
        "scenes": [
            asdict(scene) | {"stamp": _stamp(scene.model), "photographs": _photographs(scene)}
            for scene in scenes
        ],
        "rows": [
            [scene.name, name, target, _file_of(scene, name, target, settings)]
            for scene in scenes
            for name, target in row_keys(settings)
        ],
    }
    return json.dumps(about, default=str, sort_keys=True)


def _file_of(
    scene: BenchScene, name: str, target: BenchTarget, settings: BenchSettings
) -> list[Any] | None:
    """Return path, stamp and note's stamp of another tool's file for a row; None for our rows."""
    if name not in settings.externals:
        return None
    path = external_path(settings.externals[name], scene, target)
    return [str(path), _stamp(path), _stamp(note_of(path))]


def _photographs(scene: BenchScene) -> str:
    """Return a digest of the stamps of camera files and test photographs; empty without them."""
    if scene.photos is None:
        return ""
    try:
        dataset = open_dataset(scene.photos, images=scene.images)
        photos = [frame.photo_path for frame in dataset.split("test")]
    except NanogsError:  # the run gives the reason
        return ""
    files = [*dataset.camera_files, *filter(None, photos)]
    stamps = json.dumps([[str(path), _stamp(path)] for path in files])
    return hashlib.sha1(stamps.encode(), usedforsecurity=False).hexdigest()


@contextmanager
def only_run_in(folder: Path) -> Iterator[None]:
    """Make an output folder, keep other runs out of it during the block, and remove it if empty.

    Two runs at once would add rows to one unfinished run, and the later one would replace the
    results of the other. Where folders cannot be locked, as on Windows, nothing keeps them apart.

    Raises:
        OutputError: The folder cannot be made, or another run is at work in it.
    """
    with writing(folder):
        made = make_folders(folder)
    with cleaned_up(partial(remove_empty, made)), locked(folder) as alone:
        if not alone:
            raise OutputError(
                f"Another run is at work in {folder}; wait for it, or name another folder."
            )
        yield


class ResultFolder:
    """A folder that saves rows as they are measured, so that an interrupted run can be resumed.

    A finished run can be added to in the same way, as by a further method.

    Attributes:
        path: The folder.
        done: Rows that an earlier run measured and that this one needs not measure again.
    """

    def __init__(
        self, folder: str | Path, *, run: str | None = None, overwrite: bool = False
    ) -> None:
        """Create the folder, and refuse to replace results; nothing is overwritten yet.

        Args:
            folder: The folder; it is created if it is missing.
            run: From `run_of`; None for a run that is never resumed or added to.
            overwrite: Replace existing results, also those of an unfinished run.

        Raises:
            OutputError: It holds results that this run adds nothing to, or of other models or
                settings, also of an unfinished run; or it cannot be created.
        """
        self.path, self.done = Path(folder), list[BenchRow]()
        self._run, self._begun = run, False
        with writing(self.path):
            if not overwrite:
                rows = {row.key: row for row in (*self._finished_rows(), *self._rows_so_far())}
                self.done = list(rows.values())
            self._made = make_folders(self.path)

    def add(self, row: BenchRow) -> None:
        """Append a row to the unfinished run's file, unless the file has it from before.

        Raises:
            OutputError: It cannot be written.
        """
        unfinished = self.path / UNFINISHED
        if not self._begun:
            known = "".join(map(json_line, self.done))
            _replace(unfinished, f"{self._run or '{}'}\n{known}".encode())
        self._begun = True
        with writing(unfinished):
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
        if self._run is not None:
            contents[RUN] = utf8(f"{self._run}\n")
        with writing(self.path / RUN):  # no run stands beside rows of another, even if killed
            (self.path / RUN).unlink(missing_ok=True)
        for name, content in contents.items():
            _replace(self.path / name, content)
        with writing(self.path / UNFINISHED):
            (self.path / UNFINISHED).unlink(missing_ok=True)

    def abandon(self) -> None:
        """Remove what was begun here, for a run that measured nothing; rows taken over stay.

        Raises:
            OutputError: It cannot be removed.
        """
        with writing(self.path / UNFINISHED):
            if self._begun and not self.done:
                (self.path / UNFINISHED).unlink(missing_ok=True)
        remove_empty(self._made)

    def _finished_rows(self) -> list[BenchRow]:
        """Read the rows of a finished run to which this one adds.

        A run that failed or was killed while its results were written is no finished one: all its
        rows are those of the unfinished run.
        """
        if (self.path / UNFINISHED).exists() and not (self.path / RUN).exists():
            return []
        there = [self.path / name for name in (TABLE, LINES, PLOT, PAGE, PICTURE)]
        there = [path for path in there if path.exists()]
        if not there:
            return []
        run, lines = self.path / RUN, self.path / LINES
        if run.exists() and lines.exists():
            rows = self._fitting(_text(run).rstrip("\n"), _text(lines).split("\n")[:-1])
            if rows is None:
                fact = f"with rows of {_OTHER}, or methods other than these"
                add = "give all of its scenes, ratios and methods as well to add to it"
                raise ExistsError(f"{there[0]} exists already, {fact}", f"replace it, or {add}")
            asked = _files_by_key(json.loads(self._run or ""))
            if {row.key for row in rows} < asked.keys():
                return rows
        raise ExistsError(f"{there[0]} exists already")

    def _rows_so_far(self) -> list[BenchRow]:
        """Read the rows of an unfinished run; a last line that was cut off is dropped."""
        unfinished = self.path / UNFINISHED
        if not unfinished.exists():
            return []
        run, *lines = _text(unfinished).split("\n")
        rows = self._fitting(run, lines[:-1])
        if rows is None:
            fact = f"{unfinished} belongs to an unfinished run of {_OTHER}"
            raise ExistsError(fact, "begin anew, or name another folder to keep it")
        return rows

    def _fitting(self, run: str, lines: Sequence[str]) -> list[BenchRow] | None:
        """Return the rows of an earlier run that need not be measured again.

        Args:
            run: The earlier run, from `run_of`.
            lines: Its rows, from `json_line`.

        Returns:
            All but skipped and failed ones, and those of files that have changed since; None if
            this run measures in another way, or lacks a row of the earlier one, which would be
            lost.
        """
        try:
            rows = [BenchRow.from_dict(json.loads(line)) for line in lines]
            rows = [row for row in rows if row.status is Status.OK]
            if run == self._run:
                return rows
            before, now = json.loads(run), json.loads(self._run or "")
            _recall(now, before)
            files, known = _files_by_key(now), _files_by_key(before)
            alike = all(before[part] == now[part] for part in ("version", "settings"))
            alike = alike and all(scene in now["scenes"] for scene in before["scenes"])
        except (ValueError, KeyError, TypeError):  # written by another version, or by hand
            return None
        if not alike or not known.keys() <= files.keys():
            return None
        self._run = json.dumps(now, sort_keys=True)
        return [row for row in rows if row.key in known and known[row.key] == files[row.key]]


def _recall(now: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Give files that cannot be accessed in one of two runs the stamps of the other; in place.

    While a drive is not mounted, nothing is measured on its files, and other rows stay valid.

    Args:
        now: From `run_of`, parsed.
        before: The same of the earlier run.
    """
    scenes = {scene["name"]: scene for scene in before["scenes"]}
    for scene in now["scenes"]:
        earlier = scenes.get(scene["name"], scene)
        for part in ("stamp", "photographs"):
            scene[part] = scene[part] or earlier[part]
            earlier[part] = earlier[part] or scene[part]
    files = _files_by_key(before)
    for row in now["rows"]:
        name, method, target, file = row
        known = files.get((name, method, BenchTarget(*target)))
        if file and known and not file[1] and file[0] == known[0]:
            row[-1] = known


def _files_by_key(inputs: Mapping[str, Any]) -> dict[RowKey, list[Any] | None]:
    """Return the file of another tool that each row is for; None for our rows.

    Args:
        inputs: From `run_of`, parsed.
    """
    rows = inputs["rows"]
    return {(scene, name, BenchTarget(*target)): file for scene, name, target, file in rows}


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")  # bytes of ours are all ASCII


def _stamp(path: Path) -> list[int]:
    """Return size and mtime (ns) of a file; an empty list if it cannot be accessed."""
    try:
        found = path.stat()
    except OSError:
        return []
    return [found.st_size, found.st_mtime_ns]


def _replace(path: Path, content: bytes) -> None:
    """Write a file that appears whole or, on a full disk, leaves what was there before."""
    with atomic_write(path, overwrite=True) as file:
        file.write(content)
