"""A job as plain data: all that decides the bytes of its result."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from nanogs.block_layouts import Chunked, Linked
from nanogs.filters import Plain
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.asked import AUTOMATIC, Asked
from nanogs.pipeline.presets import renders
from nanogs.source import Layout

# Of others, a block sees as many splats as this share of its own, the nearest: memory is bounded.
MOST_SEEN = 0.1
VERSION = 13  # of the job folder; one of another version is not continued

_WISH = "what is asked for (ratio, count, size, PSNR, draw cost)"
_SIZE = "the memory for blocks, or their size"
# Fields of `Settings` in the words of who gave them; what follows from others comes last.
_GIVEN = {
    "version": "the version of nanogs",
    "inputs": "the input files",
    "ratios": _WISH,
    "counts": _WISH,
    "search": _WISH,
    "nan": "`nan`",
    "parameters": "the preset or its parameters",
    "chunks": "how levels are divided",
    "filters": "the filters",
    "frame": "`frame`",
    "asked": "the views (`cameras`, `up`)",
    "sh_degree": "`sh_degree`",
    "sharing": "`palette`",
    "environment": "`environment`",
    "scratch": "`scratch`",
}
_FOLLOWING = {
    "layout": "`sh_degree` or `render_mode`",
    "segments": _SIZE,
    "block": _SIZE,
}


class Access(StrEnum):
    """How the rows of a file are come by."""

    ROWS = "rows"  # any of them without the others
    PACKED = "packed"  # once the columns are unpacked, which a file of few rows is not
    WHOLE = "whole"  # all of them at once


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file as it was when the job began.

    Attributes:
        path: Absolute.
        bytes: Its size; with those of the files that it names, where it is a description.
        modified: Nanoseconds since 1970; of the last of them.
        splats: Rows in it.
        access: How they are read.
    """

    path: str
    bytes: int
    modified: int
    splats: int
    access: Access


@dataclass(frozen=True, slots=True)
class Segment:
    """Consecutive rows of what filters leave of all inputs: what is sorted at a time."""

    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Sieve:
    """The rows that filters leave of the inputs.

    Attributes:
        plain: Kind and numbers of each, as `filters.Filter.plain` has them.
        left: Splats after each.
        kept: Splats of each page of `source.base.PAGE_ROWS` rows after all.
    """

    plain: tuple[Plain, ...]
    left: tuple[int, ...]
    kept: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Sought:
    """Target of a search for a count: one of three limits, on a file of a format.

    Attributes:
        size: Bytes that the file may have, or None.
        psnr: What it must reach on views of the original, dB, or None.
        suffix: Of the format.
        options: Of the format, as text.
        draw_cost: Most that it may take to draw, as a share of what the original takes, or None.
    """

    size: int | None
    psnr: float | None
    suffix: str
    options: str
    draw_cost: float | None = None

    @property
    def is_measured(self) -> bool:
        """Whether results are held against the original on views."""
        return self.psnr is not None or self.draw_cost is not None


class Sharing(NamedTuple):
    """How many sets of higher harmonics a result has, as a palette has entries.

    Attributes:
        share: Splats for each set.
        most: Sets that the whole result has at most.
    """

    share: float
    most: int

    def entries(self, count: int, whole: int = 0) -> int:
        """Sets of so many splats, which are all of a result, or a part of a larger whole."""
        part = count / max(whole, count, 1)
        return max(int(min(count / self.share, self.most * part)), 1)


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a job.

    Attributes:
        inputs: The files, parts of one scene.
        layout: The columns of their splats.
        segments: All rows of all files.
        ratios: Of the results, finest first; empty where counts are asked for.
        counts: Splats of the results, or empty; those that a search has tried so far.
        nan: "drop" or "error".
        block: Most splats of a block.
        parameters: Of the forest.
        chunks: How results are divided or linked, or None where each is one file.
        filters: What they leave of the files; None without any.
        frame: From and to which results are turned, or None.
        asked: The views that were asked for.
        sh_degree: The highest of the results' harmonics, or None for all.
        sharing: How many sets of higher harmonics results have, or None where each splat has its
            own.
        search: What a count is searched for, or None where it is known beforehand.
        environment: The environment beside levels, in words; no task hangs on it.
    """

    inputs: tuple[InputFile, ...]
    layout: Layout
    segments: tuple[Segment, ...]
    ratios: tuple[float, ...]
    counts: tuple[int, ...]
    nan: str
    block: int
    parameters: ForestParameters
    chunks: Chunked | Linked | None = None
    filters: Sieve | None = None
    frame: tuple[str, str] | None = None
    asked: Asked = AUTOMATIC
    sh_degree: int | None = None
    sharing: Sharing | None = None
    search: Sought | None = None
    environment: str = ""

    @property
    def splats(self) -> int:
        """Rows that filters leave of all inputs."""
        return self.filters.left[-1] if self.filters else self.read

    @property
    def result_layout(self) -> Layout:
        """The columns of the results."""
        return self.layout.reduced(self.sh_degree)

    def entries(self, count: int, whole: int) -> int | None:
        """Sets of higher harmonics that so many splats of a result share.

        Args:
            count: The splats.
            whole: Splats of the result.

        Returns:
            Their number, or None where each splat has its own.
        """
        if self.sharing is None or self.result_layout.sh_degree == 0:
            return None
        return self.sharing.entries(count, whole)

    @property
    def read(self) -> int:
        """Rows of all inputs."""
        return sum(file.splats for file in self.inputs)

    @property
    def every(self) -> int:
        """Rows of a sorted segment that one code of its digest stands for.

        Two of every segment are what a block's count can be off by: a sixteenth of a block at most.
        """
        return max(min(256, self.block // (32 * len(self.segments))), 1)

    @property
    def unpacked(self) -> tuple[int, ...]:
        """Numbers of the files that are unpacked: packed ones of more rows than a segment."""
        longest = max(segment.stop - segment.start for segment in self.segments)
        return tuple(
            number
            for number, file in enumerate(self.inputs)
            if file.access is Access.PACKED and file.splats > longest
        )

    @property
    def looks(self) -> bool:
        """Whether the scene is looked at."""
        return renders(self.parameters)

    @property
    def measures(self) -> bool:
        """Whether results are chosen by how they look."""
        return self.parameters.measure

    @property
    def fits(self) -> bool:
        """Whether results are fitted to what views show."""
        return self.parameters.steps > 0

    @property
    def levels(self) -> int:
        """How many results there are."""
        return len(self.ratios) or len(self.counts)

    @property
    def chunked(self) -> Chunked:
        """The chunks of results that have them."""
        assert isinstance(self.chunks, Chunked), "this is asked in jobs with chunks"  # noqa: S101
        return self.chunks

    @property
    def linked(self) -> Linked:
        """How results are linked that become a tree."""
        assert isinstance(self.chunks, Linked), "this is asked in jobs of trees"  # noqa: S101
        return self.chunks

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as `json.dumps` takes it."""
        return {"version": VERSION, **asdict(self)}


def differences(before: Mapping[str, Any], now: Settings) -> list[str]:
    """Names of what differs between two jobs, the first as JSON holds it."""
    plain = json.loads(json.dumps(now.to_dict()))
    return [name for name, value in plain.items() if before.get(name) != value]


def in_words(names: Sequence[str]) -> str:
    """Differences of two jobs as who asked for them knows them: options and files.

    Args:
        names: As `differences` gives them, or "scratch".
    """
    given = [_GIVEN[name] for name in names if name in _GIVEN]
    found = given or [_FOLLOWING[name] for name in names]
    return ", ".join(dict.fromkeys(found))
