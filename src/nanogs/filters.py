"""Which splats to keep before anything else is done: by place, by opacity, by company.

A filter takes whole splats and changes none. The library's functions return the rest of the model;
`apply` does several in a row and reports what each took. No Numba unless floaters are looked for.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from nanogs._types import F64, Bool, F
from nanogs.errors import ModelError, OptionError
from nanogs.formatting import counted
from nanogs.ranges import is_number, value_text
from nanogs.splats import Splats, refuse_misaligned_elements, refuse_other

ENVIRONMENT = "environment"  # the filter that leaves levels without it
NEIGHBOURS = 8  # clusters of up to so many splats can be floaters
DEVIATIONS = 5.0  # of the logarithm of distances
_LEAST_SPREAD = 0.3  # of that logarithm: evenly spaced splats have none
_REACH = 3.0  # standard deviations that a splat is taken to extend


Plain = tuple[str, tuple[float, ...]]
"""The kind of a filter and its numbers, as a job records it."""


@dataclass(frozen=True, slots=True)
class Filter:
    """A rule that tells which splats stay, and its name.

    Attributes:
        name: As in `--crop`, without the dashes.
        argument: What it was given, as text; empty where it takes nothing.
        keep: (N,) bool of a model: the rows that stay.
        whole: Whether it has to see all splats to tell.
        plain: Its kind and numbers, from which `filter_of` makes it again; None of one that is not
            of this module.
    """

    name: str
    argument: str
    keep: Callable[[Splats], Bool]
    whole: bool = False
    plain: Plain | None = None


@dataclass(frozen=True, slots=True)
class FilterReport:
    """How many splats one filter took.

    Attributes:
        name: Of the filter.
        argument: What it was given.
        removed: Splats that it took.
        left: Splats after it.
    """

    name: str
    argument: str
    removed: int
    left: int


def listed(filters: Iterable[Filter]) -> tuple[Filter, ...]:
    """Filters as a caller gives them, to be gone through more than once.

    Raises:
        OptionError: They are no list of filters.
    """
    found = tuple(filters) if isinstance(filters, Iterable) else (None,)
    if not all(isinstance(each, Filter) for each in found):
        raise OptionError(
            "`filters` must be a list of filters, such as [nanogs.filters.box(low, high)]."
        )
    return found


def apply(splats: Splats, filters: Sequence[Filter]) -> tuple[Splats, tuple[FilterReport, ...]]:
    """The model that several filters leave, each looking at what those before it left.

    Raises:
        ModelError: Nothing is left, or an element has one row a splat.
    """
    left, _, reports = sift(splats, filters)
    return left, reports


def sift(
    splats: Splats, filters: Sequence[Filter]
) -> tuple[Splats, Bool, tuple[FilterReport, ...]]:
    """As `apply`, and which splats stay, (N,) bool, between the model and the reports.

    Raises:
        ModelError: As for `apply`.
    """
    refuse_other(splats)
    reports, stays = [], np.ones(len(splats), np.bool_)
    for each in filters:
        keep = each.keep(splats)
        left = int(keep.sum())
        refuse_empty(each, len(splats), left)
        reports.append(FilterReport(each.name, each.argument, len(splats) - left, left))
        if left < len(splats):
            refuse_misaligned_elements(splats, left)
            splats = splats.take(keep)
            stays[stays] = keep
    return splats, stays, tuple(reports)


def in_order(
    regions: Sequence[Filter], min_opacity: float | None, *, floaters: bool
) -> list[Filter]:
    """Filters in the order in which the command and the studio apply them.

    Args:
        regions: Boxes and spheres in which splats stay.
        min_opacity: The lowest alpha that stays, or None.
        floaters: Whether floaters are left out, of what the others have left.

    Raises:
        OptionError: The alpha is not from 0 to 1.
    """
    chosen = [*regions]
    if min_opacity is not None:
        chosen.append(opaque_enough(min_opacity))
    return [*chosen, in_company()] if floaters else chosen


def refuse_empty(given: Filter, before: int, left: int) -> None:
    """Refuse a filter that leaves nothing of so many splats.

    Raises:
        ModelError: It does.
    """
    if not left:
        what = f"{given.name} {given.argument}".strip()
        raise ModelError(f"The filter {what} leaves none of {counted(before, 'splat')}; relax it.")


def refuse_whole(filters: Sequence[Filter]) -> None:
    """Refuse filters that have to see all splats where a model is read in parts.

    Raises:
        OptionError: There is one.
    """
    for each in filters:
        if each.whole:
            raise OptionError(
                f"{each.name} needs the whole model in memory, and this one is read in parts; leave"
                f" it out, or run `nanogs convert --{each.name}` first where there is more memory."
            )


def filter_of(kind: str, values: Sequence[float]) -> Filter:
    """The filter that is `Filter.plain` of another, on another machine perhaps.

    Raises:
        OptionError: There is no such kind, or it makes no sense.
    """
    if kind == "box":
        return box(values[:3], values[3:])
    if kind == "sphere":
        return sphere(values[:3], values[3])
    if kind == "within":
        return within(values[:3], values[3])
    if kind == "beyond":
        return beyond(values[:3], values[3])
    if kind == "opacity":
        return opaque_enough(values[0])
    if kind == "company":
        return in_company(int(values[0]), values[1])
    raise OptionError(f"There is no filter {kind!r}.")


def crop_box(splats: Splats, low: Sequence[float], high: Sequence[float]) -> Splats:
    """The splats whose centres lie in a box along the axes, its faces included.

    Args:
        splats: N splats; a centre that is not finite lies nowhere.
        low: x, y, z of the lowest corner, scene units.
        high: Of the highest.

    Raises:
        OptionError: A corner is not three numbers, or low is above high.
        ModelError: No centre lies in it.
    """
    return apply(splats, [box(low, high)])[0]


def crop_sphere(splats: Splats, centre: Sequence[float], radius: float) -> Splats:
    """The splats whose centres lie in a ball, its surface included.

    Args:
        splats: N splats; a centre that is not finite lies nowhere.
        centre: x, y, z, scene units.
        radius: Scene units.

    Raises:
        OptionError: The centre is not three numbers, or the radius is not above 0.
        ModelError: No centre lies in it.
    """
    return apply(splats, [sphere(centre, radius)])[0]


def min_opacity(splats: Splats, alpha: float) -> Splats:
    """The splats whose alpha is not below a value; one that is NaN stays.

    Args:
        splats: N splats.
        alpha: In [0, 1].

    Raises:
        OptionError: It is not.
        ModelError: All are below.
    """
    return apply(splats, [opaque_enough(alpha)])[0]


def drop_floaters(
    splats: Splats, *, neighbours: int = NEIGHBOURS, deviations: float = DEVIATIONS
) -> Splats:
    """The splats that are not far from everything.

    The distance of each centre to its `neighbours`-th nearest is exact. A splat is a floater if
    that distance is far above what is usual in the model, and beyond three standard deviations of
    the splat's longest axis, so that it does not reach there either. Usual is the median; far is
    above it by `deviations` times 1.4826 median absolute deviations, all of logarithms, so that
    neither the scale of the scene nor the floaters matter; the deviation counts as 0.3 at least.
    Distances of zero, between splats in the same place, are left out of what is usual. Groups of up
    to `neighbours` splats in the void are taken, since the neighbour in question is outside.

    Args:
        splats: N splats; those whose centre or scale is not finite stay and are no neighbours.
        neighbours: Which neighbour's distance counts, 1 or more.
        deviations: How far is too far, above 0.

    Raises:
        OptionError: A parameter is out of range.
    """
    return apply(splats, [in_company(neighbours, deviations)])[0]


def box(low: Sequence[float], high: Sequence[float]) -> Filter:
    """The filter of `crop_box`."""
    bottom, top = _point(low), _point(high)
    if (bottom > top).any():
        raise OptionError(
            "The lowest corner of a box must not be above the highest: give x0,y0,z0,x1,y1,z1."
        )

    def keep(splats: Splats) -> Bool:
        inside: Bool = np.all((splats.means >= bottom) & (splats.means <= top), axis=1)
        return inside

    text = "box:" + ",".join(f"{value:g}" for value in (*bottom, *top))
    return Filter("crop", text, keep, plain=("box", (*bottom.tolist(), *top.tolist())))


def sphere(centre: Sequence[float], radius: float) -> Filter:
    """The filter of `crop_sphere`."""
    middle = _point(centre)
    if not (is_number(radius) and 0 < radius < math.inf):
        given = value_text(radius)
        raise OptionError(f"The radius of a sphere must be above 0 and finite, not {given}.")

    def keep(splats: Splats) -> Bool:
        inside: Bool = distances(splats.means, middle) <= radius
        return inside

    text = "sphere:" + ",".join(f"{value:g}" for value in (*middle, radius))
    plain = ("sphere", (*middle.tolist(), float(radius)))
    return Filter("crop", text, keep, plain=plain)


def within(centre: Sequence[float], radius: float) -> Filter:
    """The filter of a scene without its environment, what lies beyond a distance."""
    middle = _point(centre)
    plain = ("within", (*middle.tolist(), float(radius)))
    return Filter(
        ENVIRONMENT, "", lambda splats: ~(distances(splats.means, middle) > radius), plain=plain
    )


def beyond(centre: Sequence[float], radius: float) -> Filter:
    """The filter of that environment, all that `within` leaves out."""
    middle = _point(centre)
    plain = ("beyond", (*middle.tolist(), float(radius)))
    return Filter(
        ENVIRONMENT, "", lambda splats: distances(splats.means, middle) > radius, plain=plain
    )


def distances(means: F, middle: F64) -> F64:
    """(N,) distances of centres from a point, scene units; NaN of one that is not finite.

    Args:
        means: (N, 3) centres.
        middle: (3,) the point.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        away: F64 = np.linalg.norm(means.astype(np.float64) - middle, axis=1)
    return away


def opaque_enough(alpha: float) -> Filter:
    """The filter of `min_opacity`."""
    if not (is_number(alpha) and 0 <= alpha <= 1):
        raise OptionError(f"The lowest opacity must be from 0 to 1, not {value_text(alpha)}.")
    return Filter(
        "min-opacity",
        f"{alpha:g}",
        lambda splats: ~(splats.opacities() < alpha),
        plain=("opacity", (float(alpha),)),
    )


def in_company(neighbours: int = NEIGHBOURS, deviations: float = DEVIATIONS) -> Filter:
    """The filter of `drop_floaters`."""
    if not is_number(neighbours, whole=True):
        raise OptionError(f"The number of neighbours must be a whole one, not {neighbours!r}.")
    if neighbours < 1:
        raise OptionError(f"The number of neighbours must be at least 1, not {neighbours}.")
    if not (is_number(deviations) and 0 < deviations < math.inf):
        given = value_text(deviations)
        raise OptionError(f"The deviations must be above 0 and finite, not {given}.")
    return Filter(
        "drop-floaters",
        "",
        lambda splats: ~_floaters(splats, neighbours, deviations),
        whole=True,
        plain=("company", (float(neighbours), float(deviations))),
    )


def _floaters(splats: Splats, neighbours: int, deviations: float) -> Bool:
    from nanogs.neighbours import nearest_neighbours
    from nanogs.threads import use_threads

    found = np.zeros(len(splats), np.bool_)
    sizes = splats.scales().max(axis=1).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(splats.means).all(axis=1) & np.isfinite(sizes))
    means = splats.means[rows].astype(np.float64)
    if len(rows) < 2:
        return found
    with use_threads(None) as threads:
        nearest = nearest_neighbours(means, neighbours, threads)
    with np.errstate(over="ignore"):  # doubles may be that far away
        distances: F64 = np.linalg.norm(means[nearest[:, -1]] - means, axis=1)
    apart = np.log(distances[distances > 0])
    if len(apart):
        usual = float(np.median(apart))
        spread = max(1.4826 * float(np.median(np.abs(apart - usual))), _LEAST_SPREAD)
        far = distances > math.exp(usual + deviations * spread)
        found[rows] = far & (distances > _REACH * sizes[rows])
    return found


def _point(values: Sequence[float]) -> F64:
    try:
        point = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise OptionError(f"A point is three finite numbers x,y,z, not {values!r}.") from None
    if point.shape != (3,) or not np.isfinite(point).all():
        given = ",".join(f"{value:g}" for value in point.ravel())
        raise OptionError(f"A point is three finite numbers x,y,z, not {given}.")
    return point
