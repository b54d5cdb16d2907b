"""Conversion from and to gsplat's dictionary of parameter tensors.

PyTorch is not needed: every value that NumPy can convert to an array is accepted, and NumPy arrays
are returned.
"""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from nanogs._arrays import as_array, as_floats
from nanogs._types import F32, Array, F
from nanogs.activations import base_colour
from nanogs.errors import ModelError
from nanogs.splats import RenderMode, Splats

_SHAPED = {"log_scales": "scales", "quats": "quats", "opacity_logits": "opacities"}
_NEEDED = ("means", *_SHAPED.values())


def from_gsplat(tensors: Mapping[str, object], render_mode: RenderMode | str) -> Splats:
    """Make a model from gsplat's dictionary; see `Splats.from_gsplat`."""
    try:
        given = dict(tensors)
    except (TypeError, ValueError):
        raise ModelError(
            f"gsplat's dictionary of tensors is needed, not {type(tensors).__name__}."
        ) from None
    missing = [name for name in _NEEDED if name not in given]
    if missing or not given.keys() & {"colors", "sh0"}:
        lacks = ", ".join(missing) or "sh0 (or colors)"
        raise ModelError(
            f"gsplat's dictionary lacks {lacks}; it needs {', '.join(_NEEDED)}, sh0 and shN."
        )
    if "features" in given:
        raise ModelError(
            "The colours come from a network (app_opt), which splats cannot hold; train without it."
        )
    means = as_floats("means", given["means"], double=True)
    used = {*_NEEDED, *(("sh0", "shN") if "sh0" in given else ("colors",))}
    left_out = sorted(str(name) for name in given.keys() - used if given[name] is not None)
    columns: dict[str, Any] = {
        ours: as_floats(theirs, given[theirs]) for ours, theirs in _SHAPED.items()
    }
    return Splats(
        means=means,
        **columns,
        sh=_harmonics(given, len(means) if means.ndim else 0),
        render_mode=cast("RenderMode", render_mode),  # Splats checks it
        notes=[f"Left out of gsplat's dictionary: {', '.join(left_out)}."] if left_out else (),
    )


def to_gsplat(splats: Splats) -> dict[str, F32]:
    """Return copies of the columns under gsplat's names; see `Splats.to_gsplat`."""
    columns: dict[str, F] = {
        "means": splats.means,
        "scales": splats.log_scales,
        "quats": splats.quats,
        "opacities": splats.opacity_logits,
        "sh0": splats.sh[:, :1],
        "shN": splats.sh[:, 1:],
    }
    with np.errstate(over="ignore", invalid="ignore"):  # float64 centres may overflow
        return {name: np.array(column, np.float32, order="C") for name, column in columns.items()}


def _harmonics(given: Mapping[str, object], count: int) -> Array:
    """Return (N, K, 3) coefficients from `sh0` and `shN`, from `colors`, or from RGB colours."""
    if "sh0" not in given:
        colors = as_array("colors", given["colors"])
        if colors.ndim == 2 and colors.dtype.kind in "iu" and ((colors < 0) | (colors > 1)).any():
            raise ModelError(
                f"colors must be RGB from 0 to 1, not {colors.dtype} up to {colors.max()}; divide"
                " 8-bit values by 255."
            )
        floats = as_floats("colors", colors)
        return _base(floats) if floats.ndim == 2 else floats
    base = as_floats("sh0", given["sh0"])
    base = base[:, None] if base.ndim == 2 else base
    if given.get("shN") is None:
        return base
    rest = as_floats("shN", given["shN"])
    for name, part, expected in (("sh0", base, 1), ("shN", rest, "K")):
        if part.ndim != 3 or part.shape[::2] != (count, 3):
            raise ModelError(f"{name} must be ({count}, {expected}, 3), not {part.shape}.")
    return np.concatenate([base, rest], axis=1)


def _base(rgb: F) -> Array:
    """Return the (N, 1, 3) degree-0 coefficients for RGB colours (N, 3) from 0 to 1."""
    return base_colour(rgb.astype(np.float64))[:, None]
