"""A job as plain data: all that decides the bytes of its result."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from typing import Any

from nanogs.errors import FormatError
from nanogs.method.parameters import ForestParameters

# Of others, a block sees as many splats as this share of its own, the nearest: memory is bounded.
MOST_SEEN = 0.1
SOG, TILES = "streamed sog", "3d tiles"  # levels in chunks, as `lod.layout` names them
VERSION = 2  # of the job folder; one of another version is not continued


class Access(StrEnum):
    """How the rows of a file are come by."""

    ROWS = "rows"  # any of them without the others
    PACKED = "packed"  # once the columns are unpacked, which a file of one segment is not
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
    """Consecutive rows of one input file: what is sorted at a time."""

    file: int
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns that all inputs are brought to.

    Attributes:
        sh_degree: The highest of them; lower ones get coefficients of 0.
        double_means: Whether any has centres in double precision.
        extras: Name and dtype of the extra columns that all have.
        render_mode: Of all of them.
        comments: Of the first.
        notes: What is left out, one sentence each.
    """

    sh_degree: int
    double_means: bool
    extras: tuple[tuple[str, str], ...]
    render_mode: str
    comments: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Chunks:
    """How the results lie, where they are levels in chunks.

    Attributes:
        layout: `SOG` or `TILES`.
        most: Splats of the finest level in a chunk, at most.
        spz: Whether they are packed as SPZ: contents of 3D Tiles alone.
    """

    layout: str
    most: int
    spz: bool


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a job.

    Attributes:
        inputs: The files, parts of one scene.
        layout: The columns of their splats.
        segments: All rows of all files.
        ratios: Of the results, finest first; empty where counts are asked for.
        counts: Splats of the results, or empty.
        nan: "drop" or "error".
        block: Most splats of a block.
        parameters: Of the forest.
        chunks: Of the results, or None where each is one file.
    """

    inputs: tuple[InputFile, ...]
    layout: Layout
    segments: tuple[Segment, ...]
    ratios: tuple[float, ...]
    counts: tuple[int, ...]
    nan: str
    block: int
    parameters: ForestParameters
    chunks: Chunks | None = None

    @property
    def splats(self) -> int:
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
        """Numbers of the files that are unpacked: packed ones that are more than a segment."""
        segments = Counter(segment.file for segment in self.segments)
        return tuple(
            number
            for number, file in enumerate(self.inputs)
            if file.access is Access.PACKED and segments[number] > 1
        )

    @property
    def levels(self) -> int:
        """How many results there are."""
        return len(self.ratios) or len(self.counts)

    @property
    def chunked(self) -> Chunks:
        """The chunks of results that have them."""
        assert self.chunks is not None, "tasks of chunks are for jobs that have them"  # noqa: S101
        return self.chunks

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as `json.dumps` takes it."""
        return {"version": VERSION, **asdict(self)}


def settings_of(data: Mapping[str, Any]) -> Settings:
    """Settings from what `Settings.to_dict` made of them, by way of JSON.

    Raises:
        FormatError: They are damaged, or of another version.
    """
    try:
        if data["version"] != VERSION:
            raise FormatError(
                "The job was begun by another version of nanogs; remove its folder and begin anew."
            )
        layout = dict(data["layout"])
        layout["extras"] = tuple((str(name), str(kind)) for name, kind in layout["extras"])
        return Settings(
            inputs=tuple(
                InputFile(**{**each, "access": Access(each["access"])}) for each in data["inputs"]
            ),
            layout=Layout(**{k: _frozen(v) for k, v in layout.items()}),
            segments=tuple(Segment(**each) for each in data["segments"]),
            ratios=tuple(map(float, data["ratios"])),
            counts=tuple(map(int, data["counts"])),
            nan=str(data["nan"]),
            block=int(data["block"]),
            parameters=ForestParameters(**data["parameters"]),
            chunks=Chunks(**data["chunks"]) if data.get("chunks") else None,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(
            f"The job's manifest is damaged ({error}); remove its folder and begin anew."
        ) from None


def differences(before: Settings, now: Settings) -> list[str]:
    """Names of what differs between two jobs."""
    return [
        each.name
        for each in fields(Settings)
        if getattr(before, each.name) != getattr(now, each.name)
    ]


def _frozen(value: Any) -> Any:  # noqa: ANN401 - any field's
    return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
