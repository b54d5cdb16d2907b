"""Statistics of the columns of a model, accumulated block by block."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from nanogs._types import Array
from nanogs.splats import Splats


@dataclass(frozen=True, slots=True)
class ColumnStatistics:
    """Statistics of one column, in the units of a 3DGS `.ply`.

    Attributes:
        column: Its name in a 3DGS `.ply`; "f_rest, band 1" stands for all coefficients of a band.
        min: Least finite value; None if there is none, as for the next three.
        mean: Mean of the finite values.
        std: Their standard deviation.
        max: Largest finite value.
        nan: Number of values that are NaN.
        infinite: Number of infinite values.
    """

    column: str
    min: float | None
    mean: float | None
    std: float | None
    max: float | None
    nan: int
    infinite: int


@dataclass(slots=True)
class Columns:
    """Accumulates the statistics of all columns; those of an empty model are none."""

    _sums: dict[str, "_Sums"] = field(default_factory=dict)

    def add(self, block: Splats) -> None:
        """Add the rows of a block."""
        for name, values in _columns(block):
            self._sums.setdefault(name, _Sums()).add(values)

    def statistics(self) -> tuple[ColumnStatistics, ...]:
        """Return the statistics of all rows so far."""
        return tuple(sums.of(name) for name, sums in self._sums.items())


def _columns(splats: Splats) -> Iterator[tuple[str, Array]]:
    """Yield the name and the values of each numeric column."""
    for axis, name in enumerate("xyz"):
        yield name, splats.means[:, axis]
    for channel in range(3):
        yield f"f_dc_{channel}", splats.sh[:, 0, channel]
    for band in range(1, splats.sh_degree + 1):
        yield f"f_rest, band {band}", splats.sh[:, band**2 : (band + 1) ** 2]
    yield "opacity", splats.opacity_logits
    for axis in range(3):
        yield f"scale_{axis}", splats.log_scales[:, axis]
    for place in range(4):
        yield f"rot_{place}", splats.quats[:, place]
    for name, column in splats.extras.items():
        if column.dtype.kind in "biuf":
            yield name, column


@dataclass(slots=True)
class _Sums:
    """Moments of the values so far, which later blocks are merged into."""

    count: int = 0
    mean: float = 0.0
    squares: float = 0.0  # sum of the squared deviations from the mean
    least: float = math.inf
    most: float = -math.inf
    nan: int = 0
    infinite: int = 0

    def add(self, values: Array) -> None:
        """Merge a block's values (Chan, Golub and LeVeque, "Updating formulae", 1979)."""
        some = values.astype(np.float64).reshape(-1)
        nan, infinite = int(np.isnan(some).sum()), int(np.isinf(some).sum())
        self.nan, self.infinite = self.nan + nan, self.infinite + infinite
        if nan or infinite:
            some = some[np.isfinite(some)]
        if len(some) == 0:
            return
        total = self.count + len(some)
        with np.errstate(over="ignore"):  # the squares of centres in double precision may be inf
            own = float(some.mean())
            self.squares += float(np.square(some - own).sum())
        apart = own - self.mean
        self.squares += apart * apart * self.count * len(some) / total
        self.mean += apart * len(some) / total
        self.least = min(self.least, float(some.min()))
        self.most = max(self.most, float(some.max()))
        self.count = total

    def of(self, name: str) -> ColumnStatistics:
        """Return the statistics of a column of this name."""
        if self.count == 0:
            return ColumnStatistics(name, None, None, None, None, self.nan, self.infinite)
        deviation = math.sqrt(self.squares / self.count)
        return ColumnStatistics(
            name, self.least, self.mean, deviation, self.most, self.nan, self.infinite
        )
