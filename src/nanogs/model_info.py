"""`nanogs.info`: structure, bounds and statistics of a model, as one report."""

from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.column_statistics import Columns, ColumnStatistics
from nanogs.findings import join_findings
from nanogs.formatting import bytes_text, counted
from nanogs.io import FileInfo, registry
from nanogs.io import open as open_model
from nanogs.io.collect import model_in
from nanogs.io.url_files import local_copies
from nanogs.io.urls import as_path
from nanogs.lod import manifest
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.memory_estimates import info_bytes
from nanogs.percentiles import Percentiles
from nanogs.splats import Splats

_PERCENTILES = (0, 1, 5, 25, 50, 75, 95, 99, 100)


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of some values: minimum, percentiles and maximum."""

    min: float
    p1: float
    p5: float
    p25: float
    median: float
    p75: float
    p95: float
    p99: float
    max: float


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """The report of `nanogs info`.

    Attributes:
        file: Contents of the file's header.
        frame: The coordinate frame, that is which way is up, as far as the format says.
        nonfinite: Number of splats with a NaN, or an infinite value other than an opacity logit.
        opaque: Number of splats whose opacity logit is +inf (alpha 1).
        transparent: Number of splats whose opacity logit is -inf (alpha 0).
        bounds: Lowest and highest coordinates of the finite splats' centres, (2, 3) scene units;
            empty if there are none.
        alpha: Distribution of the finite splats' alpha; None if there are none.
        scale: Distribution of their standard deviations, all axes together, scene units; None if
            there are none.
        notes: Changes and losses of reading, one sentence each.
        levels: Number of splats of each level of detail of a streamed model or a folder of levels,
            the finest first; empty for other models. All other fields describe one of them.
        environment: Number of splats of a stream's environment (its sky), which are part of every
            level.
        losses: For each format that can be written, by suffix: the parts of the model that it
            cannot hold besides quantisation, one sentence each.
        columns: Statistics of each column, all splats included; empty if they were not asked for.
    """

    file: FileInfo
    frame: str
    nonfinite: int
    opaque: int
    transparent: int
    bounds: tuple[tuple[float, ...], ...]
    alpha: Distribution | None
    scale: Distribution | None
    notes: tuple[str, ...]
    levels: tuple[int, ...]
    environment: int
    losses: dict[str, tuple[str, ...]]
    columns: tuple[ColumnStatistics, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain dictionaries, lists, numbers and strings."""
        data = asdict(self)
        file = data.pop("file")
        return {**file, "path": str(file["path"]), **data}

    def __repr__(self) -> str:
        file = self.file
        low_high = " to ".join(" ".join(f"{v:.4g}" for v in corner) for corner in self.bounds)
        parts = (
            str(file.path),
            f"{file.format}, {bytes_text(file.file_bytes)}",
            counted(file.splats, "splat"),
            f"SH degree {file.sh_degree}",
            f"render mode {file.render_mode}",
            f"bounds {low_high}" if low_high else "no bounds",
        )
        return f"ModelInfo({'; '.join(parts)})"  # all fields fill a notebook's screen


def info(
    path: str | PathLike[str],
    *,
    level: int = 0,
    columns: bool = False,
    render_mode: str | None = None,
) -> ModelInfo:
    """Describe a model, which is read block by block; a large one twice, for exact percentiles.

    Args:
        path: The file, its URL, or the folder of a model.
        level: Level of detail to describe of a streamed model; 0 is the finest.
        columns: Whether to compute statistics of each column too.
        render_mode: "default" or "mip" in place of the render mode that the file names; see `open`.

    Raises:
        NanogsError: The file is missing, damaged or of no known format, it has no such level,
            cannot have that render mode, or reading it takes more memory than is free.
    """
    given = as_path(path)
    with local_copies([given]) as ([file], _):
        return _described(model_in(file), given, level, render_mode, columns=columns)


def _described(
    path: Path, given: Path, level: int, render_mode: str | None, *, columns: bool
) -> ModelInfo:
    """Describe a file; `given` is the path that the caller named: the file or its folder."""
    with open_model(path, level=level, render_mode=render_mode) as source:
        file, levels, frame = source.info, source.levels, source.frame
        environment = source.environment
        refuse_too_large(
            f"Describing {path}",
            info_bytes(source),
            allowed_memory(None, compiled=False),
        )
        census = _Census(
            Percentiles(file.splats, _PERCENTILES), Percentiles(3 * file.splats, _PERCENTILES)
        )
        every = Columns()
        for block in source.blocks():
            census.add(block)
            if columns:
                every.add(block)
        for block in source.blocks() if census.again else ():
            census.add_second_pass(block)
    return ModelInfo(
        file=file,
        frame=f"{frame}, as the file states" if frame else registry.reader(path).frame,
        nonfinite=census.seen - census.usable,
        opaque=census.opaque,
        transparent=census.transparent,
        bounds=tuple(tuple(map(float, corner)) for corner in census.bounds),
        alpha=_spread(census.alphas),
        scale=_spread(census.scales),
        notes=join_findings(census.notes),
        levels=levels or manifest.level_counts(given),
        environment=environment,
        losses={suffix: join_findings(parts) for suffix, parts in census.losses.items()},
        columns=every.statistics(),
    )


@dataclass(slots=True)
class _Census:
    """Statistics that are accumulated block by block."""

    alphas: Percentiles
    scales: Percentiles
    seen: int = 0
    usable: int = 0
    opaque: int = 0
    transparent: int = 0
    bounds: tuple[F64, ...] = ()
    notes: list[tuple[str, ...]] = field(default_factory=list)
    losses: dict[str, list[tuple[str, ...]]] = field(default_factory=dict)

    def add(self, block: Splats) -> None:
        self.notes.append(tuple(block.notes))
        for suffix, sentences in registry.losses_by_format(block).items():
            self.losses.setdefault(suffix, []).append(sentences)
        self.opaque += int((block.opacity_logits == np.inf).sum())
        self.transparent += int((block.opacity_logits == -np.inf).sum())
        usable = block.take(block.finite())
        self.alphas.add(usable.opacities().astype(np.float32))
        self.scales.add(usable.scales().astype(np.float32).reshape(-1))
        means = usable.means.astype(np.float64)
        if len(means):
            both = np.concatenate([means, *(corner[None] for corner in self.bounds)])
            self.bounds = both.min(axis=0), both.max(axis=0)
        self.seen += len(block)
        self.usable += len(usable)

    @property
    def again(self) -> bool:
        """Whether `add_second_pass` needs all blocks in a second pass."""
        return self.alphas.again or self.scales.again

    def add_second_pass(self, block: Splats) -> None:
        usable = block.take(block.finite())
        if self.alphas.again:
            self.alphas.add_second_pass(usable.opacities().astype(np.float32))
        if self.scales.again:
            self.scales.add_second_pass(usable.scales().astype(np.float32).reshape(-1))


def _spread(values: Percentiles) -> Distribution | None:
    found = values.values()
    return None if found is None else Distribution(*found)
