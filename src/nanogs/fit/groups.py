"""Validation views in groups by picture size and distance; a fit must not harm any group."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs.fit.targets import Target, squared_error
from nanogs.raster.camera import pick_evenly
from nanogs.raster.rendering import PreparedSplats

FEWEST = 4  # views needed for a group of its own
RANGE = 4.0  # ratio of the largest to the least pixel footprint that splits near from far views
EXACT = 2e-6  # mean squared error below which a view counts as equal: rounding to 8 bits, 57 dB


@dataclass(frozen=True, slots=True, eq=False)
class ViewGroup:
    """Validation views of similar picture size and distance.

    Attributes:
        name: The group's name in the report.
        targets: The views, one or more.
    """

    name: str
    targets: tuple[Target, ...]

    def psnr(self, model: PreparedSplats) -> float:
        """Return the mean PSNR over the views, dB: so no view with large errors dominates."""
        errors = [squared_error(model, target) for target in self.targets]
        return float(-10 * np.log10(np.maximum(errors, EXACT)).mean())


def grouped(targets: Sequence[Target]) -> list[ViewGroup]:
    """Group views by picture size and, if distances differ much, into a near and a far half.

    The distance is measured by the footprint of a pixel at the median depth of the visible splats.
    """
    groups = []
    for views in _by_size(targets):
        pixels = f"{pixels_text(views)} px"
        near = sorted(views, key=lambda view: view.footprint)
        half = len(near) // 2
        known = near[0].footprint < math.inf
        if known and half >= FEWEST and near[-1].footprint >= RANGE * near[0].footprint:
            groups.append(ViewGroup(f"{pixels}, near", tuple(near[:half])))
            groups.append(ViewGroup(f"{pixels}, far", tuple(near[half:])))
        else:
            groups.append(ViewGroup(pixels, tuple(views)))
    return groups


def pixels_text(targets: Sequence[Target]) -> str:
    """Say the range of the lengths of the views' longer sides in pixels: "512 to 900"."""
    sizes = sorted({_longer(target) for target in targets})
    return " to ".join(str(size) for size in sizes[:: max(1, len(sizes) - 1)])


def hold_out(groups: Sequence[ViewGroup], count: int) -> list[ViewGroup]:
    """Select validation views from each group, together about `count`.

    At least one and at most a quarter of each group; two or more if that allows it.
    """
    held = []
    for group in groups:
        fair = max(2, count // len(groups)) if len(groups) > 1 else count
        number = min(fair, max(1, len(group.targets) // 4))
        held.append(ViewGroup(group.name, tuple(pick_evenly(group.targets, number))))
    return held


def split(
    targets: Sequence[Target], count: int
) -> tuple[tuple[Target, ...], tuple[ViewGroup, ...]]:
    """Split views into those to fit to and about `count` validation views, in groups.

    Each view is in one part. If there is only one view, none is left to fit to.
    """
    deciding = tuple(hold_out(grouped(targets), count))
    held = [target for group in deciding for target in group.targets]
    return tuple(target for target in targets if target not in held), deciding


def _by_size(targets: Sequence[Target]) -> list[list[Target]]:
    """Group views by their longer side, to the nearest power of two; small groups are joined."""
    sizes: dict[int, list[Target]] = {}
    for target in targets:
        sizes.setdefault(round(math.log2(_longer(target))), []).append(target)
    groups: list[list[Target]] = []
    for size in sorted(sizes):
        if groups and min(len(groups[-1]), len(sizes[size])) < FEWEST:
            groups[-1] = groups[-1] + sizes[size]
        else:
            groups.append(sizes[size])
    return groups


def _longer(target: Target) -> int:
    return max(target.camera.width, target.camera.height)
