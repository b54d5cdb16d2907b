"""What is in a model: structure, bounds and statistics, as one report."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F
from nanogs.io import FileInfo, inspect, load

_QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """What `nanogs info` reports.

    Attributes:
        file: What the header says.
        nonfinite: Splats with a NaN or an infinite value other than an opacity logit.
        opaque: Splats whose opacity logit is +inf (alpha 1).
        transparent: Splats whose opacity logit is -inf (alpha 0).
        bounds: Lowest and highest centre of the finite splats, (2, 3) scene units.
        alpha: Quantiles 0, 0.05, 0.5, 0.95 and 1 of the finite splats' alpha.
        scale: The same of their standard deviations, all axes together, scene units.
        notes: What reading had to change or could not carry.
    """

    file: FileInfo
    nonfinite: int
    opaque: int
    transparent: int
    bounds: tuple[tuple[float, ...], ...]
    alpha: tuple[float, ...]
    scale: tuple[float, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and strings."""
        data = asdict(self)
        return {**data.pop("file"), **data}


def describe(path: str | Path) -> ModelInfo:
    """Read a model and describe it.

    Args:
        path: The file.

    Raises:
        NanogsError: The file is missing, damaged or of no known format.
    """
    splats = load(path)
    finite = splats.finite()
    usable = splats.take(finite)
    bounds: tuple[tuple[float, ...], ...] = ()
    if len(usable):
        low, high = usable.means.min(axis=0), usable.means.max(axis=0)
        bounds = (tuple(map(float, low)), tuple(map(float, high)))
    return ModelInfo(
        file=inspect(path),
        nonfinite=int((~finite).sum()),
        opaque=int((splats.opacity_logits == np.inf).sum()),
        transparent=int((splats.opacity_logits == -np.inf).sum()),
        bounds=bounds,
        alpha=_quantiles(usable.opacities()),
        scale=_quantiles(usable.scales()),
        notes=tuple(splats.notes),
    )


def _quantiles(values: F) -> tuple[float, ...]:
    return tuple(map(float, np.quantile(values, _QUANTILES))) if values.size else ()
