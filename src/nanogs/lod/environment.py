"""Finding a model's environment: its sky, or whatever else stands around it far away on all sides.

Seen from the middle of the model, an environment is a shell with nothing before it. Models that
were trained with a dome of sky have one; the ground and the houses of other scenes reach from near
to far without a gap, and splats that strayed cover next to nothing of what is seen. So distances
are counted on a logarithmic scale, and an environment is what lies

- beyond a gap of `GAP` in distance, in which there are fewer than `STRAYS` as many splats,
- at least `FAR` times as far away as half of the splats before the gap,
- no more than half of all splats, since the scale begins at half of their median distance, and
- in `COVERED` of all directions at least so densely that splats cover half of what is seen there.

What is taken for an environment is drawn all the same: viewers show it with every level.
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
_STEPS = 8  # to a doubling of the distance
_DOUBLINGS = 40  # from half of the median distance on; what is beyond these is in the last step
_SIDE = 4  # directions are divided as the six faces of a cube are, each into so many squared
_DIRECTIONS = 6 * _SIDE**2
_OPAQUE = 0.5  # of a direction
_SAMPLE, _STRETCH = 1 << 18, 1024  # rows that the middle is found from, and how many lie together


@dataclass(frozen=True, slots=True)
class Shell:
    """An environment: what lies beyond a distance.

    Attributes:
        centre: x, y, z of the middle of the model, scene units.
        radius: The distance, scene units.
        splats: How many lie beyond it, of those that are usable.
    """

    centre: tuple[float, float, float]
    radius: float
    splats: int


def find_environment(source: Source) -> Shell | None:
    """The environment of a model; None of one that has none.

    The model is read twice, some rows at a time, the first time a part of it. Splats that are not
    usable count nowhere.

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
    counts, angles = _counted(source.blocks(), middle, edges)
    found = _begin_of_shell(counts, angles)
    if found is None:
        return None
    x, y, z = middle.tolist()
    return Shell((x, y, z), float(edges[found - 1]), int(counts[found:].sum()))


def _sample(source: Source) -> F64:
    """(M, 3) usable centres of stretches of rows that are spread evenly over the model."""
    every = max(-(-source.count // _SAMPLE), 1) * _STRETCH
    parts = []
    for start in range(0, source.count, every):
        part = source.read(start, min(start + _STRETCH, source.count))
        parts.append(part.means[part.finite()])
    return np.concatenate([np.empty((0, 3)), *parts])


def _counted(blocks: Iterable[Splats], middle: F64, edges: F64) -> tuple[I64, F64]:
    """(S,) splats by step of distance, and (S, D) what they cover of each direction, steradians.

    Step 0 lies up to the first edge, the last beyond the last one.
    """
    steps = len(edges) + 1
    counts, angles = np.zeros(steps, np.int64), np.zeros(steps * _DIRECTIONS)
    for block in blocks:
        own = block.take(block.finite())
        away = distances(own.means, middle)
        step = np.searchsorted(edges, away, side="left")
        counts += np.bincount(step, minlength=steps)
        far = np.flatnonzero(step)  # what is near is part of no shell
        widest = np.sort(own.scales()[far].astype(np.float64), axis=1)[:, 1:]
        # A Gaussian's integral over a plane is its peak times 2 pi times the product of its widths;
        # one that is wider than it is far away covers all that is seen.
        shares = np.minimum(widest / away[far, None], 1.0)
        covered = 2 * np.pi * own.opacities()[far] * shares.prod(axis=1)
        place = step[far] * _DIRECTIONS + _directions(own.means[far] - middle)
        angles += np.bincount(place, weights=covered, minlength=len(angles))
    return counts, angles.reshape(steps, _DIRECTIONS)


def _directions(offsets: F64) -> I64:
    """(N,) the part of a cube's faces that each of (N, 3) offsets, none of them zero, points to."""
    axis = np.abs(offsets).argmax(axis=1)
    rows = np.arange(len(offsets))
    along = offsets[rows, axis]
    across = np.stack([offsets[rows, (axis + turn) % 3] for turn in (1, 2)], axis=1)
    places = (across / np.abs(along)[:, None] + 1) / 2 * _SIDE
    u, v = np.clip(places.astype(np.int64), 0, _SIDE - 1).T
    found: I64 = ((2 * axis + (along > 0)) * _SIDE + u) * _SIDE + v
    return found


def _begin_of_shell(counts: I64, angles: F64) -> int | None:
    """The first step of a shell, the gap before it ending there; None without one.

    Of several places for the gap it is the emptiest, and of those the one in the middle.
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
    """Whether (S, D) steradians of each direction cover enough of all that is seen."""
    opaque = angles.sum(axis=0) >= _OPAQUE * 4 * np.pi / _DIRECTIONS
    return bool(opaque.mean() >= COVERED)
