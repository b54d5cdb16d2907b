"""Which way is up, where the model shows it clearly: away from the ground it stands on."""

from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, Bool
from nanogs.views.occupancy import Core, Matter, capped, quantiles

HABIT_UP = (0.0, -1.0, 0.0)  # how trained models lie
LAYERS = 20  # along each axis; a ground is two of them thick
FLAT = 0.9  # cosine between a splat's normal and the axis
ROUND = 0.9  # thickness over the next longer axis, from which a splat has no normal
BENEATH = 0.1  # share of the area that may lie under a ground
ENOUGH = 0.1  # share of the area that a ground has at least, to turn the model by
ENOUGH_OVER = 0.05  # to turn it upside down
LEAD = 1.5  # times what a rival direction has
WIDE = 0.75  # reach of a ground over that of everything, level


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Places (n, 3), unit normals (n, 3), 0 for round splats, and areas (n,) that add up to 1."""

    points: F64
    normals: F64
    areas: F64

    def lying(self, up: F64) -> float:
        """Share of the area that lies flat if this is up."""
        return float(self.areas[np.abs(self.normals @ up) > FLAT].sum())


def detect_up(matter: Matter, core: Core) -> F64:
    """(3,) unit float64: the direction in which the model rises from its ground.

    A ground is a thin and wide layer of flat-lying splats with hardly anything beneath. Only the
    six directions of the axes are tried, and habit, (0, -1, 0), needs clear evidence against it:
    the direction must have half as much ground again as any rival. For a model upside down only
    habit itself is the rival, as the walls of a room are no ground. Where nothing is clear, as with
    objects cut out of their scene, it is the habit. A lone wall in z passes for a ground, and so
    does a ceiling without a floor.
    """
    surfaces = surfaces_of(matter, core)
    habit = np.array(HABIT_UP)
    over, turned = ground(surfaces, -habit), ground(surfaces, habit)
    if over >= max(ENOUGH_OVER, LEAD * turned):
        turned, habit = over, -habit
    sideways = np.array([(sign * axis) for axis in np.eye(3)[[0, 2]] for sign in (1.0, -1.0)])
    grounds = np.array([ground(surfaces, up) for up in sideways])
    second, best = np.sort(grounds)[-2:]
    if best >= max(ENOUGH, LEAD * second, LEAD * turned):
        habit = sideways[int(np.argmax(grounds))]
    return habit


def surfaces_of(matter: Matter, core: Core) -> Surfaces:
    """The core as pieces of surface: splats lie flat across their shortest axis."""
    arms = matter.arms[core.rows]
    normals = np.cross(arms[:, 0], arms[:, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    widths = np.linalg.norm(arms[:, 1], axis=1)
    normals[matter.thicknesses[core.rows] > ROUND * widths] = 0
    areas = capped(matter.areas[core.rows])
    total = areas.sum() or 1.0
    return Surfaces(
        matter.points[core.rows], normals / np.where(lengths > 0, lengths, 1), areas / total
    )


def ground(surfaces: Surfaces, up: F64) -> float:
    """Share of the area that is a ground if this is up, 0 where there is none."""
    heights = surfaces.points @ up
    low, high = quantiles(heights, surfaces.areas, 0.01, 0.99)
    if not high > low:
        return 0.0
    lying = np.abs(surfaces.normals @ up) > FLAT
    edges = np.linspace(low, high, LAYERS + 1)
    flat, _ = np.histogram(heights, edges, weights=surfaces.areas * lying)
    pairs = np.concatenate([[0], flat[:-1] + flat[1:], [0]])
    peaks = (pairs[1:-1] >= pairs[:-2]) & (pairs[1:-1] >= pairs[2:])
    beneath = np.array([surfaces.areas[heights < edge].sum() for edge in edges[:-2]])
    # The most of those that may be one: a ceiling can have more area than the floor.
    layers = pairs[1:-1] * (peaks & (beneath <= BENEATH))
    start = int(np.argmax(layers))
    if not layers[start]:  # the lowest layer of a thick heap is no ground
        return 0.0
    within = (heights >= edges[start]) & (heights <= edges[start + 2]) & lying
    if not _is_wide(surfaces, up, within):
        return 0.0
    return float(surfaces.areas[within].sum())


def _is_wide(surfaces: Surfaces, up: F64, within: Bool) -> bool:
    """Whether what lies in the layer reaches as far to the sides as everything does."""
    level = surfaces.points - np.outer(surfaces.points @ up, up)
    centre = np.median(level, axis=0)
    reach = np.linalg.norm(level - centre, axis=1)
    layer = quantiles(reach[within], surfaces.areas[within], 0.9)[0] if within.any() else 0.0
    return layer >= WIDE * quantiles(reach, surfaces.areas, 0.9)[0]
