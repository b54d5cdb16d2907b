"""Views that decide, in groups by picture size and distance: a fit must serve each of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs.fit.targets import Target, squared_error
from nanogs.raster.camera import evenly
from nanogs.raster.rendering import PreparedSplats

FEWEST = 4  # views that make a group of their own
RANGE = 4.0  # largest footprint of a pixel over the least, from which near and far are two groups
EXACT = 2e-6  # mean squared error below which a view counts as equal: what 8 bits leave, 57 dB


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Views of about one picture size and distance.

    Attributes:
        name: For the report.
        targets: The views, one or more.
    """

    name: str
    targets: tuple[Target, ...]

    def psnr(self, model: PreparedSplats) -> float:
        """Mean over the views, dB: a view of large errors does not drown the others."""
        errors = [squared_error(model, target) for target in self.targets]
        return float(-10 * np.log10(np.maximum(errors, EXACT)).mean())


def grouped(targets: Sequence[Target]) -> list[Group]:
    """Sort views by picture size and, where distances differ much, into a near and a far half.

    Distance is the footprint of a pixel at the median depth of what is seen.
    """
    groups = []
    for views in _by_size(targets):
        pixels = f"{pixels_text(views)} px"
        near = sorted(views, key=lambda view: view.footprint)
        half = len(near) // 2
        known = near[0].footprint < math.inf
        if known and half >= FEWEST and near[-1].footprint >= RANGE * near[0].footprint:
            groups.append(Group(f"{pixels}, near", tuple(near[:half])))
            groups.append(Group(f"{pixels}, far", tuple(near[half:])))
        else:
            groups.append(Group(pixels, tuple(views)))
    return groups


def pixels_text(targets: Sequence[Target]) -> str:
    """Pixels along the longer sides of views, of the smallest to the largest: "512 to 900"."""
    sizes = sorted({_longer(target) for target in targets})
    return " to ".join(str(size) for size in sizes[:: max(1, len(sizes) - 1)])


def hold_out(groups: Sequence[Group], count: int) -> list[Group]:
    """The part of each group that decides, together about `count` views.

    At least one and at most a quarter of the group; two or more where that allows it.
    """
    held = []
    for group in groups:
        fair = max(2, count // len(groups)) if len(groups) > 1 else count
        number = min(fair, max(1, len(group.targets) // 4))
        held.append(Group(group.name, tuple(evenly(group.targets, number))))
    return held


def split(targets: Sequence[Target], count: int) -> tuple[tuple[Target, ...], tuple[Group, ...]]:
    """Views to fit to, and about `count` others that decide, in groups; each view is in one part.

    Of a single view none is left to fit to.
    """
    deciding = tuple(hold_out(grouped(targets), count))
    held = [target for group in deciding for target in group.targets]
    return tuple(target for target in targets if target not in held), deciding


def _by_size(targets: Sequence[Target]) -> list[list[Target]]:
    """Views by the longer side of their pictures, to the nearest power of two; few join others."""
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
