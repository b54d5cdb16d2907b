"""The settings of a job as plain data: everything that decides the bytes of its results."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any

from nanogs._version import __version__
from nanogs.block_layouts import Chunked, Linked
from nanogs.filters import Plain
from nanogs.io.format import Sharing, shared_entries
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.options.presets import renders
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.options.views import AUTOMATIC, RequestedViews
from nanogs.source import Layout

# Most splats of a block's halo, as a share of its own, to bound memory; the nearest are kept.
MOST_HALO = 0.1
FINE, ROUGH = 0, 1  # indices of the coarse levels of the scene
# Limits on the splats of each coarse level: a share of the scene's splats, and a number for each
# splat of a block, which fits into memory because they are only rendered. `COARSE_LEAST` splats are
# always allowed, however small the blocks are.
COARSE_SHARES, COARSE_OF_BLOCK, COARSE_LEAST = (0.9, 0.125), (1.0, 0.5), (1 << 18, 1 << 15)
# A job is continued only by the release that began it. The number increases with each change of the
# job folder's format, or of the results, between releases.
VERSION = f"{__version__}, 31"

# Steps of the fit of results that are only compared with each other: a share of all, but this many
# at least. More steps, or corrected errors, hardly change which packing is the best.
BRIEF, LEAST_STEPS = 0.05, 4

_WISH = "the request (ratio, count, size, PSNR, draw cost)"
_SIZE = "the memory for blocks, or their size"
# Fields of `Settings` in the user's terms; then those that are derived from others.
_GIVEN = {
    "version": "the version of nanogs",
    "inputs": "the input files",
    "ratios": _WISH,
    "counts": _WISH,
    "at_most": _WISH,
    "search": _WISH,
    "nan": "`nan`",
    "parameters": "the preset or its parameters",
    "block_layout": "how levels are divided, or their place on Earth",
    "filters": "the filters",
    "frame": "`frame`",
    "asked": "the views (`cameras`, `up`)",
    "sh_degree": "`sh_degree`",
    "sharing": "the format or `palette`",
    "rounded": "the format",
    "environment": "`environment`",
    "scratch": "`scratch`",
}
_FOLLOWING = {
    "layout": "`sh_degree` or `render_mode`",
    "segments": _SIZE,
    "block": _SIZE,
}


class Access(StrEnum):
    """How the rows of an input file are read: by random access, after unpacking, or all at once."""

    ROWS = "rows"  # any of them can be read without the others
    PACKED = "packed"  # as ROWS, once the columns are unpacked, which is done for large files only
    WHOLE = "whole"  # all of them at once


@dataclass(frozen=True, slots=True)
class InputFile:
    """An input file, and its identity when the job began.

    Attributes:
        path: Absolute.
        bytes: Its size; with those of the files that it names, if it is a description of others.
        modified: Time of the last modification of any of them, nanoseconds since 1970.
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
    """Consecutive rows of the filtered inputs that are sorted together."""

    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class FilterCounts:
    """The filters of a job, and the number of rows that they leave.

    Attributes:
        plain: Kind and numbers of each filter, as in `filters.Filter.plain`.
        left: Number of splats after each filter.
        kept: Splats of each page of `source.base.PAGE_ROWS` rows after all filters.
    """

    plain: tuple[Plain, ...]
    left: tuple[int, ...]
    kept: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SearchTarget:
    """Target of a search for a count: one of three limits, on a file of a format.

    Attributes:
        size: Bytes that the file may have, or None.
        psnr: PSNR that it must reach on views of the original, dB, or None.
        suffix: Of the format.
        options: Of the format, as text.
        draw_cost: Most that it may take to draw, as a share of what the original takes, or None.
        most: Splats that a writer of the format may hold whole; None for any number. A palette is
            tried only within it.
    """

    size: int | None
    psnr: float | None
    suffix: str
    options: str
    draw_cost: float | None = None
    most: int | None = None

    @property
    def goal(self) -> Goal:
        """The limit as a goal."""
        return Goal(size=self.size, psnr=self.psnr, draw_cost=self.draw_cost)


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a job.

    Attributes:
        inputs: The files, parts of one scene.
        layout: The columns of their splats.
        segments: All rows that filters leave of all files, in parts that are sorted together.
        ratios: Of the results, finest first; empty if counts are asked for.
        counts: Splats of the results, or empty; in a search, the counts tried so far.
        nan: "drop" or "error".
        block: Largest number of splats of a block.
        parameters: Of the forest.
        block_layout: How results are divided or linked, or None if each is one file.
        filters: The filters, and the number of rows they leave; None without any.
        frame: Frames from and to which results are turned, or None.
        asked: The views that were asked for.
        sh_degree: Highest degree of the results' harmonics, or None for all.
        sharing: How splats of results share higher harmonics, or None if each has its own.
        search: Target of the search for a count, or None if it is known beforehand.
        environment: The environment beside levels, in words; no task depends on it.
        at_most: Whether the counts are the most that fit into a size, so that all splats are kept
            if fewer are usable.
        rounded: Whether results of known counts are rounded so that their files pack well.
    """

    inputs: tuple[InputFile, ...]
    layout: Layout
    segments: tuple[Segment, ...]
    ratios: tuple[float, ...]
    counts: tuple[int, ...]
    nan: str
    block: int
    parameters: ForestParameters
    block_layout: Chunked | Linked | None = None
    filters: FilterCounts | None = None
    frame: tuple[str, str] | None = None
    asked: RequestedViews = AUTOMATIC
    sh_degree: int | None = None
    sharing: Sharing | None = None
    search: SearchTarget | None = None
    environment: str = ""
    at_most: bool = False
    rounded: bool = False

    @property
    def splats(self) -> int:
        """Rows that filters leave of all inputs."""
        return self.filters.left[-1] if self.filters else self.read_count

    @property
    def result_layout(self) -> Layout:
        """The columns of the results."""
        return self.layout.reduced(self.sh_degree)

    def entries(self, count: int, whole: int) -> int | None:
        """Return the number of sets of higher harmonics that splats of a result share.

        Args:
            count: Number of these splats.
            whole: Splats of the whole result.

        Returns:
            The number of sets, or None if each splat has its own.
        """
        return shared_entries(self.sharing, self.result_layout.sh_degree, count, whole)

    @property
    def read_count(self) -> int:
        """Rows of all inputs."""
        return sum(file.splats for file in self.inputs)

    @property
    def rows_per_code(self) -> int:
        """Number of rows of a sorted segment for each code of its digest.

        If it is above 1, a block's count can be off by two of these for every segment: a sixteenth
        of a block at most.
        """
        return max(min(256, self.block // (32 * len(self.segments))), 1)

    @property
    def unpacked(self) -> tuple[int, ...]:
        """Indices of the files to unpack: packed ones of more rows than a segment."""
        longest = max(segment.stop - segment.start for segment in self.segments)
        return tuple(
            number
            for number, file in enumerate(self.inputs)
            if file.access is Access.PACKED and file.splats > longest
        )

    @property
    def looks(self) -> bool:
        """Whether the scene is rendered."""
        return renders(self.parameters)

    @property
    def guided(self) -> bool:
        """Whether candidates are rendered and the one that looks best is chosen."""
        return self.parameters.guided

    @property
    def fits(self) -> bool:
        """Whether results are fitted to renders of the original."""
        return self.parameters.steps > 0

    @property
    def keeps_curvatures(self) -> bool:
        """Whether it is kept how much the values of fitted results show, to round them by."""
        return self.rounded or self.search is not None

    @property
    def levels(self) -> int:
        """Number of results."""
        return len(self.ratios) or len(self.counts)

    @property
    def chunked(self) -> Chunked:
        """How results are divided into chunks, in jobs that do so."""
        assert isinstance(self.block_layout, Chunked), "this is asked in jobs with chunks"  # noqa: S101
        return self.block_layout

    @property
    def linked(self) -> Linked:
        """How results are linked to a tree, in jobs that do so."""
        assert isinstance(self.block_layout, Linked), "this is asked in jobs of trees"  # noqa: S101
        return self.block_layout

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as `json.dumps` takes it."""
        return {"version": VERSION, **asdict(self)}


def most_coarse(level: int, block: int, splats: int) -> int:
    """Return the most splats of a coarse level of the scene, enough for it to hide what is behind.

    Args:
        level: `FINE` or `ROUGH`.
        block: Largest number of splats of a block.
        splats: Number of splats of the scene.
    """
    beside = max(int(COARSE_OF_BLOCK[level] * block), COARSE_LEAST[level])
    return min(int(splats * COARSE_SHARES[level]), beside)


def plain(settings: Settings, rounds: int | None = None) -> Settings:
    """Return the settings for results that are cut without rendering.

    Args:
        settings: The usual settings.
        rounds: Rounds of reassignment; by default unchanged.
    """
    given = settings.parameters
    parameters = replace(
        given, guided=False, steps=0, rounds=given.rounds if rounds is None else rounds
    )
    return replace(settings, parameters=parameters)


def brief(settings: Settings) -> Settings:
    """Return the settings for results that are only compared: a short fit and no corrections.

    Args:
        settings: The usual settings.
    """
    given = settings.parameters
    steps = min(max(math.ceil(BRIEF * given.steps), LEAST_STEPS), given.steps)
    return replace(settings, parameters=replace(given, steps=steps, corrections=0))


def differences(before: Mapping[str, Any], now: Settings) -> list[str]:
    """Return the names of the settings in which two jobs differ, the first as read from JSON."""
    after = json.loads(json.dumps(now.to_dict()))
    return [name for name, value in after.items() if before.get(name) != value]


def in_words(names: Sequence[str]) -> str:
    """Describe the differences of two jobs in the user's terms: options and files.

    Args:
        names: As `differences` gives them, or "scratch".
    """
    given = [_GIVEN[name] for name in names if name in _GIVEN]
    found = given or [_FOLLOWING[name] for name in names]
    return ", ".join(dict.fromkeys(found))
