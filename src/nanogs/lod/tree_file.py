"""The sink for levels as one tree in a single file, Spark's `.rad`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from nanogs.block_layouts import BlockTree
from nanogs.io import check_writable, losses
from nanogs.io.format import FormatOptions
from nanogs.io.models import as_splats
from nanogs.io.rad.write import SUFFIX, write
from nanogs.lod.manifest import Manifest, describe_levels
from nanogs.lod.tree import Linking, as_rows
from nanogs.lod.tree_blocks import Linked, joined_trees
from nanogs.progress import PartProgress, ignore_progress
from nanogs.report import SimplifyReport
from nanogs.sink import InOneFile, Judge, OpenSink, Written, made_beside
from nanogs.source import InMemory, Source, source_of
from nanogs.splats import Splats
from nanogs.switches import tree_pixel


@dataclass(frozen=True, slots=True)
class LevelsTree(InOneFile):
    """A sink that writes levels as one tree into a file; see `sink.Sink`.

    Attributes:
        place: The file to make.
        overwrite: Whether an existing file is replaced.
        source: Name of the model for the manifest.
        block_layout: The layout that links levels made in blocks.
    """

    place: Path
    overwrite: bool
    source: str
    block_layout: Linked = field(default_factory=Linked)
    suffix: str = SUFFIX
    format_options: None = None
    environment: None = None

    def refuse_large(self, count: int, row: int, max_memory: int | None) -> None:
        """Refuse nothing: blocks are linked separately and streamed to the file; see `Sink`."""

    def check(self) -> None:
        """Check that the file can be written; see `Sink`."""
        check_writable(self.place, overwrite=self.overwrite)

    def open(self, making: Path, options: FormatOptions) -> "TreeFilling":  # noqa: ARG002
        """Start a new file at `making`; see `Sink`."""
        making.unlink(missing_ok=True)
        return TreeFilling(making, self.place.name, self.source)

    @contextmanager
    def filled(self) -> Iterator["TreeFilling"]:
        """Fill a temporary file in a `with` block, then move it to `place` if no error occurred.

        Raises:
            OutputError: The file may not be replaced, or it cannot be written.
        """
        with made_beside(self, SUFFIX) as made:
            yield self.open(made, {})


class TreeFilling(OpenSink):
    """A collector of levels, which writes the tree when the coarsest level is known."""

    def __init__(self, making: Path, name: str, source: str) -> None:
        super().__init__()
        self._making, self._name, self._source = making, name, source
        self._leaves: Source | None = None
        self._linking = Linking()
        self._trees: Sequence[BlockTree] = ()
        self._linked, self._further = 0, list[Source]()
        self._some: Splats | None = None
        self._on_progress: PartProgress = ignore_progress

    def add_trees(
        self,
        trees: Sequence[BlockTree],
        levels: int,
        some: Splats,
        on_progress: PartProgress = ignore_progress,
    ) -> None:
        """Take the trees of blocks, for the levels added afterwards; see `OpenSink`."""
        self._trees, self._linked, self._some, self._on_progress = trees, levels, some, on_progress

    def add(self, model: Splats | Source, on_progress: PartProgress = ignore_progress) -> None:
        """Link a level to the previous one, unless the trees of blocks include it already."""
        on_progress(0, 1)
        number, source = len(self.written), source_of(model)
        count, notes = source.count, list[str]()
        if number < self._linked:
            count = sum(tree.layers[number].count for tree in self._trees)
            if count != source.count:
                notes.append(
                    f"Level {number} of the tree has {count:,} splats, not {source.count:,}: blocks"
                    " that would have more than at the finer level repeat that; levels that are"
                    " farther apart keep their counts."
                )
        elif self._trees:
            self._further.append(InMemory(as_splats(source)))
        else:
            level = InMemory(as_splats(source))
            self._leaves = self._leaves or level
            self._linking.add(level)
        left_out = losses(model, self._making)
        self.written.append(Written(count, (self._name,), 0, left_out, notes=notes))

    def finish(self, reports: Sequence[SimplifyReport], judge: Judge | None = None) -> Manifest:
        """Write the tree, and measure the quality of each level.

        Args:
            reports: The report of each level.
            judge: Measures levels; None to measure nothing.
        """
        count = self._write()
        size = self._making.stat().st_size
        self.written[:] = [
            each._replace(bytes=size * each.splats // count) for each in self.written
        ]
        files = [(self._making, level) for level in range(len(self.written))]
        self.measure(judge, files, lambda _level, deviation: tree_pixel(deviation))
        if any(report.fit for report in reports):
            note = (
                "Inner splats of the tree are made anew, so that they fit each other, and little of"
                f" the fit of the preset {reports[0].preset!r} is left in them; without it,"
                " `steps=0`, the tree takes less time."
            )
            first = self.written[0]
            self.written[0] = first._replace(notes=[*first.notes, note])
        return describe_levels(self._source, reports, self.written)

    def _write(self) -> int:
        """Write the file and return its number of rows."""
        with self._making.open("wb") as file:
            if self._some is not None:
                rows = joined_trees(self._trees, self._further, self._some, self._on_progress)
                write(rows, file, tree=rows)
                return rows.count
            assert self._leaves is not None, "there is one level at least"  # noqa: S101
            source, tree = as_rows(self._leaves, self._linking.finished())
            write(source, file, tree=tree)
            return source.count
