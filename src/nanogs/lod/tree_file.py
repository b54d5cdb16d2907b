"""The sink of levels that become one tree: Spark's `.rad`, a single file."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from nanogs.block_layouts import BlockTree
from nanogs.io import losses
from nanogs.io.format import FormatOptions
from nanogs.io.models import as_splats
from nanogs.io.rad.write import SUFFIX, write
from nanogs.lod.manifest import Manifest, describe_levels
from nanogs.lod.tree import Linking, as_rows
from nanogs.lod.tree_blocks import Linked, joined_trees
from nanogs.progress import Parts, untold
from nanogs.report import SimplifyReport
from nanogs.sink import Filling, Judge, OneFile, Written, made_beside
from nanogs.source import InMemory, Source, source_of
from nanogs.splats import Splats
from nanogs.switches import tree_pixel


@dataclass(frozen=True, slots=True)
class LevelsTree:
    """A sink of levels; see `sink.Sink`.

    Attributes:
        place: The file to make.
        overwrite: Whether a file that exists is replaced.
        source: Name of the model for what is told of the levels.
        chunks: How levels are linked where they are made in blocks.
    """

    place: Path
    overwrite: bool
    source: str
    chunks: Linked = field(default_factory=Linked)
    suffix: str = SUFFIX
    environment: None = None

    @property
    def _file(self) -> OneFile:
        return OneFile(self.place, self.overwrite)

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """As `Sink` says: blocks are linked each by itself, and what is written is not held."""

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
        self._leaves: Source | None = None
        self._linking = Linking()
        self._trees: Sequence[BlockTree] = ()
        self._linked, self._further = 0, list[Source]()
        self._some: Splats | None = None
        self._tell: Parts = untold

    def add_trees(
        self, trees: Sequence[BlockTree], levels: int, some: Splats, tell: Parts = untold
    ) -> None:
        """As `Filling` says."""
        self._trees, self._linked, self._some, self._tell = trees, levels, some, tell

    def add(self, model: Splats | Source, tell: Parts = untold) -> None:
        """Link a level to the one before, unless blocks have been linked as far as that."""
        tell(0, 1)
        number, source = len(self.written), source_of(model)
        count = source.count
        if number < self._linked:
            count = sum(tree.layers[number].count for tree in self._trees)
        elif self._trees:
            self._further.append(InMemory(as_splats(source)))
        else:
            level = InMemory(as_splats(source))
            self._leaves = self._leaves or level
            self._linking.add(level)
        left_out = losses(model, self._making)
        self.written.append(Written(count, (self._making.name,), 0, left_out))

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """Write the tree, and measure each level.

        Args:
            reports: Of each level.
            judge: Measures levels.
        """
        count = self._write()
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

    def _write(self) -> int:
        """Write the file, and count its rows."""
        with self._making.open("wb") as file:
            if self._some is not None:
                rows = joined_trees(self._trees, self._further, self._some, self._tell)
                write(rows, file, tree=rows)
                return rows.count
            assert self._leaves is not None, "there is one level at least"  # noqa: S101
            source, tree = as_rows(self._leaves, self._linking.finished())
            write(source, file, tree=tree)
            return source.count
