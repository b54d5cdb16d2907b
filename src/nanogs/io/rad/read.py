"""Reading `.rad` (Spark), with and without a tree; the layout is in `header`.

Of a tree, level 0 is read by default: its leaves in the order of the file, which are the model that
the tree was built from. Level N has coarser nodes, up to N steps above the leaves (see `levels`).
Chunks are decoded separately and the last one is kept, so that rows can be read in parts.
"""

from collections.abc import Sequence
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import numpy as np

from nanogs._types import F64, I64, Array
from nanogs.activations import base_colour
from nanogs.errors import FormatError
from nanogs.findings import Finding, negative_scales
from nanogs.io import render_tag
from nanogs.io.files import damaged
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource, check_level
from nanogs.io.rad.header import BANDS, CHILD_COUNT, CODES, LABEL, Chunk, read_header
from nanogs.io.rad.levels import Heights, heights
from nanogs.io.rad.values import (
    check_encoding,
    components,
    log_steps,
    rotations,
    shapes,
    type_name,
)
from nanogs.io.texts import printable
from nanogs.slices import overlapping
from nanogs.source import joined_rows, span_of
from nanogs.splats import Splats, empty_arrays


class RadFile(FileSource):
    """The source of a `.rad` file, or of one level of its tree.

    A scale of zero becomes a log-scale of -inf; alphas of 0 and 1 become logits of -inf and +inf.

    Args:
        path: The file.
        level: The level of a tree to read; 0 is the finest.

    Raises:
        FormatError: It cannot be read, is no `.rad` file, or its headers or tree are damaged.
        OptionError: It has no such level.
    """

    def __init__(self, path: Path, level: int = 0) -> None:
        super().__init__(path)
        self._header, self._level = read_header(path), level
        for chunk in self._header.chunks:
            for column in chunk.properties.values():
                check_encoding(column)
        self._bases = [0, *accumulate(chunk.count for chunk in self._header.chunks)]
        self._last: tuple[int, Splats] | None = None
        if level:
            check_level(path, level, len(self.levels) or 1)

    @cached_property
    def info(self) -> FileInfo:
        """The file's description; for a tree, this counts the rows of the level."""
        header = self._header
        first = header.chunks[0].properties.values()
        comments = self._comments
        return FileInfo(
            path=self.path,
            format="rad",
            encoding="deflate" if any(c.packed for c in first) else "binary_little_endian",
            file_bytes=header.file_bytes,
            splats=self._ends[-1],
            sh_degree=header.degree,
            properties=tuple((column.name, type_name(column.encoding)) for column in first),
            render_mode=render_tag.render_mode(comments),
            render_tag=render_tag.described(comments),
            comments=tuple(map(printable, comments)),
        )

    @property
    def files(self) -> Sequence[Path]:
        """The file, and the separate files of its chunks; see `FileSource`."""
        return self._header.files

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of splats of each level of a tree; see `FileSource`."""
        return self._heights.counts() if self._header.tree else ()

    @cached_property
    def _heights(self) -> Heights:
        return heights(self._header)

    def _rows(self, number: int) -> Array:
        """Return a (count,) bool mask of the rows of a tree's chunk that are in the level."""
        if not self._level:
            chunk = self._header.chunks[number]
            leaves: Array = components(chunk.properties[CHILD_COUNT], chunk.count, 1)[:, 0] == 0
            return leaves
        rows = slice(self._bases[number], self._bases[number + 1])
        own, parents = self._heights
        chosen: Array = (own[rows] <= self._level) & (parents[rows] > self._level)
        return chosen

    @property
    def _comments(self) -> list[str]:
        comment = self._header.comment
        return [] if comment is None else [line.rstrip("\r") for line in comment.split("\n")]

    @cached_property
    def _ends(self) -> list[int]:
        """Cumulative number of rows, from 0 to the end of each chunk; only rows of the level."""
        chunks, tree = self._header.chunks, self._header.tree
        counts = [
            int(self._rows(number).sum()) if tree else chunk.count
            for number, chunk in enumerate(chunks)
        ]
        if not any(counts):
            raise damaged(self.path, "its tree has no leaf")
        return list(accumulate(counts, initial=0))

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source`."""
        parts = [
            span_of(self._chunk(number), low, high)
            for number, low, high in overlapping(self._ends, start, stop)
        ]
        return joined_rows(parts or [span_of(self._chunk(0), 0, 0)])

    def _chunk(self, number: int) -> Splats:
        """Decode a chunk, of a tree only the rows of the level; the last one is cached."""
        last = self._last  # once, because another thread may read another chunk
        if last is None or last[0] != number:
            last = self._last = None  # freed before the next one is decoded
            chunk = self._header.chunks[number]
            rows = np.flatnonzero(self._rows(number)) if self._header.tree else None
            with np.errstate(all="ignore"):  # the file may hold NaN, infinity, zero scales
                last = self._last = number, self._unpacked(chunk, rows)
        return last[1]

    def _unpacked(self, chunk: Chunk, rows: I64 | None) -> Splats:
        """Decode the given rows of a chunk, or all."""
        chosen = slice(None) if rows is None else rows
        columns, count = chunk.properties, chunk.count
        out = empty_arrays(count if rows is None else len(rows), self._header.degree)
        sizes = columns["scales"]
        logarithms = sizes.encoding != "f32"
        scales = log_steps(sizes, count) if sizes.encoding == "ln_0r8" else None
        scales = components(sizes, count, 3) if scales is None else scales
        alphas = components(columns["alpha"], count, 1)[:, 0]
        drawn = shapes(alphas[chosen], scales[chosen], logarithms=logarithms)
        out["means"][:] = components(columns["center"], count, 3)[chosen]
        out["log_scales"][:], out["opacity_logits"][:] = drawn.log_scales, drawn.logits
        out["quats"][:] = rotations(columns["orientation"], count)[chosen]
        out["sh"][:, 0] = base_colour(components(columns["rgb"], count, 3)[chosen])
        self._fill_bands(chunk, chosen, out["sh"])
        notes = negative_scales(drawn.negative)
        if drawn.widened:
            text = (
                "{:splat has|splats have} an alpha above 1, as in Spark's trees, and became opaque"
                " and larger."
            )
            notes.append(Finding(text, drawn.widened))
        comments = self._comments
        mode = render_tag.render_mode(comments)
        return Splats(**out, render_mode=mode, comments=comments, notes=notes)

    def _fill_bands(self, chunk: Chunk, chosen: "slice | I64", sh: Array) -> None:
        """Write the higher SH coefficients of the chosen rows of a chunk into `sh`."""
        if not self._header.degree:
            return
        if self._header.codes:
            labels = components(chunk.properties[LABEL], chunk.count, 1)[:, 0][chosen]
            if labels.max(initial=0) >= self._header.codes:
                raise FormatError(
                    f"{chunk.properties[LABEL].where} names entries beyond the palette's"
                    f" {self._header.codes:,}; export or download it again."
                )
            for place, entries in self._palette:
                sh[:, place] = entries[labels]
            return
        for place, name in zip(_places(self._header.degree), BANDS, strict=False):
            sh[:, place] = _band(chunk, name, chunk.count)[chosen]

    @cached_property
    def _palette(self) -> list[tuple[slice, F64]]:
        """The range of coefficients and the palette entries of each band, from the first chunk."""
        degree, first = self._header.degree, self._header.chunks[0]
        return [
            (place, _band(first, name, self._header.codes))
            for place, name in zip(_places(degree), CODES, strict=False)
        ]

    def close(self) -> None:
        """Free the chunk that was read last."""
        self._last = None


def _places(degree: int) -> list[slice]:
    """Return the index range in `Splats.sh` of each band from degree 1 on."""
    return [slice(band * band, (band + 1) ** 2) for band in range(1, degree + 1)]


def _band(chunk: Chunk, name: str, count: int) -> F64:
    """Decode a band, or its palette, to (count, coefficients, 3)."""
    width = 3 * (2 * (1 + (BANDS if name in BANDS else CODES).index(name)) + 1)
    values: F64 = components(chunk.properties[name], count, width).reshape(count, -1, 3)
    return values
