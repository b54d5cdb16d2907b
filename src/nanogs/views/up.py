"""Detection of the up direction: away from the ground that the model stands on."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, Bool
from nanogs.views.occupancy import Core, SplatSample, capped, quantiles

HABIT_UP = (0.0, -1.0, 0.0)  # the usual up direction of trained models
LAYERS = 20  # number of layers along each axis; a ground is two of them thick
FLAT = 0.9  # least cosine between the normal of a flat-lying splat and the axis
ROUND = 0.9  # thickness over the next longer axis, above which a splat has no normal
BENEATH = 0.1  # largest share of the area beneath a ground
ENOUGH = 0.1  # least share of the area in a ground, for up to differ from the usual direction
ENOUGH_OVER = 0.05  # the same for a model upside down
LEAD = 1.5  # least ratio of a ground's area to that of any rival direction
WIDE = 0.75  # least horizontal reach of a ground over that of the model


@dataclass(frozen=True, slots=True)
class Surfaces:
    """Splats as pieces of surface.

    Attributes:
        points: (n, 3) float64, positions.
        normals: (n, 3) float64, unit; 0 for round splats.
        areas: (n,) float64, normalised to a sum of 1.
    """

    points: F64
    normals: F64
    areas: F64

    def lying(self, up: F64) -> float:
        """Return the share of the area that is horizontal if `up` is up."""
        return float(self.areas[np.abs(self.normals @ up) > FLAT].sum())


def stated_up(comments: Iterable[str]) -> F64 | None:
    """Return the up direction that the comments of a .ply state, (3,) unit float64; else None.

    nerfstudio states `Vertical Axis: z`, and its models have z up. Other axes say less, because
    programs differ in whether y points up or down.
    """
    stated = any(comment.strip().lower() == "vertical axis: z" for comment in comments)
    return np.array([0.0, 0.0, 1.0]) if stated else None


def detect_up(sampled: SplatSample, core: Core, usual: F64 | None = None) -> F64:
    """Detect the up direction, (3,) unit float64: away from the model's ground.

    A ground is a thin and wide layer of flat-lying splats with hardly anything beneath. Only the
    six directions of the axes are tried, and the usual one is kept without clear evidence against
    it: another direction must have 1.5 times the ground area of any rival. For a model upside down
    the only rival is the usual direction, because the walls of a room are no ground. If nothing is
    clear, as for objects cut out of their scene, the usual direction is returned. With the default,
    a lone wall in z is mistaken for a ground, and so is a ceiling without a floor.

    Args:
        sampled: The model.
        core: Its dense part.
        usual: The usual direction, (3,), along an axis; (0, -1, 0) by default.
    """
    surfaces = surfaces_of(sampled, core)
    habit = np.array(HABIT_UP) if usual is None else usual
    over, turned = ground(surfaces, -habit), ground(surfaces, habit)
    if over >= max(ENOUGH_OVER, LEAD * turned):
        turned, habit = over, -habit
    level = np.eye(3)[habit == 0]
    sideways = np.array([(sign * axis) for axis in level for sign in (1.0, -1.0)])
    grounds = np.array([ground(surfaces, up) for up in sideways])
    second, best = np.sort(grounds)[-2:]
    if best >= max(ENOUGH, LEAD * second, LEAD * turned):
        habit = sideways[int(np.argmax(grounds))]
    return habit


def surfaces_of(sampled: SplatSample, core: Core) -> Surfaces:
    """Convert the core to pieces of surface: the normal of a splat is its shortest axis."""
    arms = sampled.arms[core.rows]
    normals = np.cross(arms[:, 0], arms[:, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    widths = np.linalg.norm(arms[:, 1], axis=1)
    normals[sampled.thicknesses[core.rows] > ROUND * widths] = 0
    areas = capped(sampled.areas[core.rows])
    total = areas.sum() or 1.0
    return Surfaces(
        sampled.points[core.rows], normals / np.where(lengths > 0, lengths, 1), areas / total
    )


def ground(surfaces: Surfaces, up: F64) -> float:
    """Return the share of the area that is a ground if `up` is up; 0 if there is none."""
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
    # The largest layer that qualifies as a ground: a ceiling can have more area than the floor.
    layers = pairs[1:-1] * (peaks & (beneath <= BENEATH))
    start = int(np.argmax(layers))
    if not layers[start]:  # no layer qualifies: the lowest layer of a thick heap is no ground
        return 0.0
    within = (heights >= edges[start]) & (heights <= edges[start + 2]) & lying
    if not _is_wide(surfaces, up, within):
        return 0.0
    return float(surfaces.areas[within].sum())


def _is_wide(surfaces: Surfaces, up: F64, within: Bool) -> bool:
    """Return whether the splats in the layer extend horizontally about as far as the model."""
    level = surfaces.points - np.outer(surfaces.points @ up, up)
    centre = np.median(level, axis=0)
    reach = np.linalg.norm(level - centre, axis=1)
    layer = quantiles(reach[within], surfaces.areas[within], 0.9)[0] if within.any() else 0.0
    return layer >= WIDE * quantiles(reach, surfaces.areas, 0.9)[0]
