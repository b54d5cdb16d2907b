"""Finding a model's environment: its sky, or another far shell of splats around the model.

Seen from the middle of the model, an environment is a shell with empty space before it. Models
trained with a sky dome have one. In other scenes, the ground and the houses reach from near to far
without a gap, and stray splats cover almost nothing of the view. So a histogram of distances is
made on a logarithmic scale, and an environment consists of the splats beyond a distance such that

- before it there is an interval over a factor of `GAP` in distance, with at most `STRAYS` as many
  splats as beyond it,
- it is at least `FAR` times the median distance of the splats before it,
- at most half of all splats are beyond it, because the scale begins at half of their median
  distance, and
- in at least `COVERED` of all directions, splats beyond it cover half of the view or more.

A wrong guess loses nothing: viewers draw the environment with every level.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, I64
from nanogs.filters import distances
from nanogs.source import Source
from nanogs.splats import Splats

GAP = 2.0
STRAYS = 0.01
FAR = 4.0
COVERED = 0.25
_STEPS = 8  # histogram steps per doubling of the distance
_DOUBLINGS = 40  # of half of the median distance; the last step holds everything beyond
_SIDE = 4  # directions are binned on the faces of a cube, each divided into 4 x 4 squares
_DIRECTIONS = 6 * _SIDE**2
_OPAQUE = 0.5  # share of a bin of directions that must be covered
# Number of rows from which the middle is computed, and length of each run of consecutive ones.
_SAMPLE, _STRETCH = 1 << 18, 1024


@dataclass(frozen=True, slots=True)
class Shell:
    """An environment: all splats beyond a distance from the middle of the model.

    Attributes:
        centre: x, y, z of the middle of the model, scene units.
        radius: The distance, scene units.
        splats: Number of splats beyond it.
        usable: Number of these without NaN or infinite values.
    """

    centre: tuple[float, float, float]
    radius: float
    splats: int
    usable: int


def find_environment(source: Source) -> Shell | None:
    """Find the environment of a model; return None if there is none.

    The model is read twice, some rows at a time, the first time only a sample. Splats that are not
    usable do not affect the distance, and are counted.

    Args:
        source: The model.

    Raises:
        NanogsError: It cannot be read.
    """
    some = _sample(source)
    if not len(some):
        return None
    middle = np.median(some.astype(np.float64), axis=0)
    typical = float(np.median(distances(some, middle)))
    if not 0 < typical < np.inf:
        return None
    edges = typical * 2.0 ** (np.arange(_STEPS * _DOUBLINGS + 1) / _STEPS - 1)
    every, counts, angles = _counted(source.blocks(), middle, edges)
    found = _begin_of_shell(counts, angles)
    if found is None:
        return None
    x, y, z = middle.tolist()
    splats, usable = int(every[found:].sum()), int(counts[found:].sum())
    return Shell((x, y, z), float(edges[found - 1]), splats, usable)


def _sample(source: Source) -> F64:
    """Return (M, 3) usable centres from runs of rows that are spread evenly over the model."""
    every = max(-(-source.count // _SAMPLE), 1) * _STRETCH
    parts = []
    for start in range(0, source.count, every):
        part = source.read(start, min(start + _STRETCH, source.count))
        parts.append(part.means[part.finite()])
    return np.concatenate([np.empty((0, 3)), *parts])


def _counted(blocks: Iterable[Splats], middle: F64, edges: F64) -> tuple[I64, I64, F64]:
    """Compute histograms by step of distance.

    Step 0 is below the first edge, the last step is beyond the last edge.

    Returns:
        (S,) the number of splats with a finite centre, (S,) the number of usable ones, and (S, D)
        the solid angle in steradians that these cover in each bin of directions.
    """
    steps = len(edges) + 1
    every = np.zeros(steps, np.int64)
    counts, angles = np.zeros(steps, np.int64), np.zeros(steps * _DIRECTIONS)
    for block in blocks:
        away, usable = distances(block.means, middle), block.finite()
        step = np.searchsorted(edges, away, side="left")
        every += np.bincount(step[np.isfinite(away)], minlength=steps)
        own, away, step = block.take(usable), away[usable], step[usable]
        counts += np.bincount(step, minlength=steps)
        far = np.flatnonzero(step)  # splats of step 0 cannot be part of a shell
        widest = np.sort(own.scales()[far].astype(np.float64), axis=1)[:, 1:]
        # A Gaussian's integral over a plane is its peak times 2 pi times the product of its
        # deviations; these are limited to the distance, where it covers the whole view.
        shares = np.minimum(widest / away[far, None], 1.0)
        covered = 2 * np.pi * own.opacities()[far] * shares.prod(axis=1)
        place = step[far] * _DIRECTIONS + _directions(own.means[far] - middle)
        angles += np.bincount(place, weights=covered, minlength=len(angles))
    return every, counts, angles.reshape(steps, _DIRECTIONS)


def _directions(offsets: F64) -> I64:
    """Return (N,) the bin of directions of each of (N, 3) non-zero offsets: a square of a cube."""
    axis = np.abs(offsets).argmax(axis=1)
    rows = np.arange(len(offsets))
    along = offsets[rows, axis]
    across = np.stack([offsets[rows, (axis + turn) % 3] for turn in (1, 2)], axis=1)
    places = (across / np.abs(along)[:, None] + 1) / 2 * _SIDE
    u, v = np.clip(places.astype(np.int64), 0, _SIDE - 1).T
    found: I64 = ((2 * axis + (along > 0)) * _SIDE + u) * _SIDE + v
    return found


def _begin_of_shell(counts: I64, angles: F64) -> int | None:
    """Return the first step of the shell, at which the gap ends; None if there is no shell.

    Of several possible gaps the emptiest is taken, and of equally empty ones the middle one.
    """
    wide, near = round(_STEPS * np.log2(GAP)), round(_STEPS * np.log2(FAR))
    before = np.concatenate([[0], np.cumsum(counts)])
    whole, places = int(before[-1]), list[tuple[int, int]]()
    for begin in range(wide + 1, len(counts)):
        gap = int(before[begin] - before[begin - wide])
        inner, outer = int(before[begin]), whole - int(before[begin])
        half = int(np.searchsorted(before[1:], inner / 2, side="left"))
        far = begin - 1 - half >= near
        if outer and gap <= STRAYS * outer and far and _covers(angles[begin:]):
            places.append((gap, begin))
    emptiest = [begin for gap, begin in places if gap == min(places)[0]]
    return emptiest[len(emptiest) // 2] if emptiest else None


def _covers(angles: F64) -> bool:
    """Return whether (S, D) covered steradians make enough of the directions opaque."""
    opaque = angles.sum(axis=0) >= _OPAQUE * 4 * np.pi / _DIRECTIONS
    return bool(opaque.mean() >= COVERED)
