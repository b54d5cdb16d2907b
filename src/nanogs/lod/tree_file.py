"""The sink of levels that become one tree: Spark's `.rad`, a single file."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from nanogs.errors import OptionError
from nanogs.io import losses, save
from nanogs.io import open as open_model
from nanogs.io.format import FormatOptions
from nanogs.io.rad.write import SUFFIX, write
from nanogs.lod.manifest import Manifest, describe_levels
from nanogs.lod.tree import as_rows, layers_of
from nanogs.progress import Parts, untold
from nanogs.report import SimplifyReport
from nanogs.sink import Filling, Judge, OneFile, Written, made_beside
from nanogs.source import InMemory, Source, source_of
from nanogs.splats import Splats
from nanogs.switches import tree_pixel

_LINKING = 220  # bytes for a splat of the finest level, while it is linked to the next; measured
_HELD = ".npz"  # which keeps all of a level that is not in memory


@dataclass(frozen=True, slots=True)
class LevelsTree:
    """A sink of levels; see `sink.Sink`.

    Attributes:
        place: The file to make.
        overwrite: Whether a file that exists is replaced.
        source: Name of the model for what is told of the levels.
    """

    place: Path
    overwrite: bool
    source: str
    chunks: None = None
    suffix: str = SUFFIX
    environment: None = None

    @property
    def _file(self) -> OneFile:
        return OneFile(self.place, self.overwrite)

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:  # noqa: ARG002
        """As `Sink` says: links between levels are held whole."""
        if max_memory is not None and count * _LINKING > max_memory:
            raise OptionError(
                f"{self.place}: linking levels of {count:,} splats takes"
                f" {count * _LINKING / 1e9:.1f} GB; name a lod-meta.json, or raise `max_memory`."
            )

    def check(self) -> None:
        """As `Sink` says."""
        self._file.check()

    def open(self, making: Path, options: FormatOptions) -> "TreeFilling":  # noqa: ARG002
        """As `Sink` says."""
        making.unlink(missing_ok=True)
        return TreeFilling(making, self.source)

    @contextmanager
    def filled(self) -> Iterator["TreeFilling"]:
        """The sink opened beside its place, which it takes when the block ends without an error.

        Raises:
            OutputError: The file may not be replaced, or it cannot be written.
        """
        with made_beside(self, SUFFIX) as made:
            yield self.open(made, {})

    def move(self, made: Path) -> None:
        """As `Sink` says."""
        self._file.move(made)

    def files(self, made: Path) -> Sequence[str]:
        """As `Sink` says."""
        return self._file.files(made)


class TreeFilling(Filling):
    """Levels that wait for the coarsest one: only then is there a tree."""

    def __init__(self, making: Path, source: str) -> None:
        super().__init__()
        self._making, self._source = making, source
        self._levels: list[Source] = []
        self._stack = ExitStack()

    def add(self, model: Splats | Source, tell: Parts = untold) -> None:
        """Keep a level: one in memory as it is, others in a file beside the result."""
        tell(0, 1)
        number, source = len(self._levels), source_of(model)
        if not isinstance(source, InMemory):
            if not number:
                folder = TemporaryDirectory(dir=self._making.parent, prefix="levels-")
                self._folder = Path(self._stack.enter_context(folder))
            path = self._folder / f"{number}{_HELD}"
            save(source, path)
            source = self._stack.enter_context(open_model(path))
        self._levels.append(source)
        left_out = losses(model, self._making)
        self.written.append(Written(source.count, (self._making.name,), 0, left_out))

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """Write the tree, and measure each level.

        Args:
            reports: Of each level.
            judge: Measures levels.
        """
        with self._stack:
            rows, tree = as_rows(self._levels[0], layers_of(self._levels))
            with self._making.open("wb") as file:
                write(rows, file, tree=tree)
            count = rows.count
            rows.close()
        size = self._making.stat().st_size
        self.written[:] = [
            each._replace(bytes=size * each.splats // count) for each in self.written
        ]
        files = [(self._making, level) for level in range(len(self.written))]
        self.measure(judge, files, lambda _level, deviation: tree_pixel(deviation))
        made = describe_levels(self._source, reports, self.written)
        if not any(report.refit for report in reports):
            return made
        note = (
            "Splats that stand for others are made anew, so that they fit each other in a tree, and"
            f" not as {made.preset!r} fitted them: the preset 'fast' takes less time for as much."
        )
        return replace(made, notes=(*made.notes, note))
