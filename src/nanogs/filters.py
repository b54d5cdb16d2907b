"""Filters that remove splats before anything else is done: by place, opacity, isolation or NaN.

A filter removes whole splats and changes none. The public functions return the filtered model;
`apply` runs several filters in turn and reports how many splats each removed. Numba is imported
only to find floaters.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nanogs._types import F64, Bool, F
from nanogs.errors import ModelError, OptionError
from nanogs.formatting import counted, exact_text
from nanogs.ranges import is_number, value_text
from nanogs.splats import Splats, refuse_misaligned_elements, refuse_other

ENVIRONMENT = "environment"  # name of the filter that takes the environment out of the levels
NEIGHBOURS = 8  # clusters of up to this number of splats can be floaters
DEVIATIONS = 5.0  # of the logarithm of distances
_LEAST_SPREAD = 0.3  # least deviation of that logarithm: evenly spaced splats have none
_REACH = 3.0  # extent of a splat in standard deviations


Plain = tuple[str, tuple[float, ...]]
"""A filter in serialisable form, for the records of jobs: its kind and its numbers."""


@dataclass(frozen=True, slots=True)
class Filter:
    """A named predicate that selects the splats to keep.

    Attributes:
        name: Name of the command's option without the dashes, such as "crop".
        argument: The option's value as text; empty if it takes none.
        keep: Function of a model of N splats that returns an (N,) bool mask of the rows to keep.
        whole: Whether it needs all splats at once.
        plain: Kind and numbers, from which `filter_of` makes the filter again; None for a filter
            that was not made by this module.
    """

    name: str
    argument: str
    keep: Callable[[Splats], Bool]
    whole: bool = False
    plain: Plain | None = None

    def mask(self, splats: Splats) -> Bool:
        """Return the (N,) bool mask of the rows to keep.

        Raises:
            OptionError: `keep` returned something else.
        """
        found = np.asarray(self.keep(splats))
        if found.dtype != bool or found.shape != (len(splats),):
            raise OptionError(
                f"The filter {self.name!r} must return one flag for each of"
                f" {counted(len(splats), 'splat')}, not {found.dtype} of shape {found.shape}."
            )
        return found

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the plain form, since the functions of this module's filters are local."""
        if self.plain is not None:
            return filter_of, self.plain
        return Filter, (self.name, self.argument, self.keep, self.whole)


@dataclass(frozen=True, slots=True)
class FilterReport:
    """Number of splats that one filter removed.

    Attributes:
        name: Name of the filter.
        argument: Its argument as text.
        removed: Number of splats that it removed.
        left: Number of splats after it.
    """

    name: str
    argument: str
    removed: int
    left: int


def checked_filters(filters: Iterable[Filter]) -> tuple[Filter, ...]:
    """Return a caller's filters as a tuple, after a check of their type.

    Raises:
        OptionError: The value is not an iterable of filters.
    """
    found = tuple(filters) if isinstance(filters, Iterable) else (None,)
    if not all(isinstance(each, Filter) for each in found):
        raise OptionError(
            "`filters` must be a list of filters, such as [nanogs.filters.box(low, high)]."
        )
    return found


def apply(splats: Splats, filters: Sequence[Filter]) -> tuple[Splats, tuple[FilterReport, ...]]:
    """Apply several filters in turn, each to the splats that those before it kept.

    Returns:
        The filtered model, and the report of each filter.

    Raises:
        ModelError: No splat is left, or a further PLY element has one row for each splat.
        OptionError: They are no filters, or one returns no mask.
    """
    left, _, reports = apply_with_mask(splats, filters)
    return left, reports


def apply_with_mask(
    splats: Splats, filters: Sequence[Filter]
) -> tuple[Splats, Bool, tuple[FilterReport, ...]]:
    """Apply several filters in turn, and also return the mask of the splats that stay.

    Returns:
        The filtered model, an (N,) bool mask of the input's rows, and the report of each filter.

    Raises:
        ModelError: See `apply`.
    """
    refuse_other(splats)
    reports, stays = [], np.ones(len(splats), np.bool_)
    for each in checked_filters(filters):
        keep = each.mask(splats)
        left = int(keep.sum())
        refuse_empty(each, len(splats), left)
        reports.append(FilterReport(each.name, each.argument, len(splats) - left, left))
        if left < len(splats):
            refuse_misaligned_elements(splats, left)
            splats = splats.take(keep)
            stays[stays] = keep
    return splats, stays, tuple(reports)


def in_order(
    regions: Sequence[Filter], min_opacity: float | None, *, floaters: bool, nan: bool = False
) -> list[Filter]:
    """Return the filters in the order in which the command and the studio apply them.

    Args:
        regions: Boxes and spheres in which splats stay.
        min_opacity: The lowest alpha to keep, or None.
        floaters: Whether floaters are removed, after the other filters.
        nan: Whether splats with a NaN or an infinite value are removed, before the other filters.

    Raises:
        OptionError: The alpha is not from 0 to 1.
    """
    chosen = [all_finite(), *regions] if nan else [*regions]
    if min_opacity is not None:
        chosen.append(opaque_enough(min_opacity))
    return [*chosen, in_company()] if floaters else chosen


def refuse_empty(given: Filter, before: int, left: int) -> None:
    """Refuse a filter that leaves none of `before` splats.

    Raises:
        ModelError: No splat is left.
    """
    if not left:
        what = f"{given.name} {given.argument}".strip()
        raise ModelError(f"The filter {what} leaves none of {counted(before, 'splat')}; relax it.")


def refuse_whole(filters: Sequence[Filter]) -> None:
    """Refuse filters that need all splats at once, for a model that is read in parts.

    Raises:
        OptionError: There is such a filter.
    """
    for each in filters:
        if each.whole:
            raise OptionError(
                f"{each.name} needs the whole model in memory, but this model is read in parts;"
                f" leave the filter out, or first run `nanogs convert --{each.name}` on a machine"
                " with more memory."
            )


# How many numbers the record of each kind of filter has, and what makes the filter of them.
_KINDS: dict[str, tuple[int, Callable[[Sequence[float]], Filter]]] = {
    "box": (6, lambda values: box(values[:3], values[3:])),
    "sphere": (4, lambda values: sphere(values[:3], values[3])),
    "within": (4, lambda values: within(values[:3], values[3])),
    "beyond": (4, lambda values: beyond(values[:3], values[3])),
    "opacity": (1, lambda values: opaque_enough(*values)),
    "finite": (0, lambda _values: all_finite()),
    "company": (2, lambda values: _in_company(*values)),
}


def filter_of(kind: str, values: Sequence[float]) -> Filter:
    """Make a filter from the kind and numbers in `Filter.plain`, perhaps of another machine.

    Raises:
        OptionError: There is no such kind, or its numbers are invalid.
    """
    if not isinstance(kind, str) or kind not in _KINDS:
        raise OptionError(f"There is no filter {kind!r}.")
    length, make = _KINDS[kind]
    if not (isinstance(values, Sequence) and len(values) == length and all(map(is_number, values))):
        raise OptionError(
            f"The filter {kind!r} is recorded as {counted(length, 'number')}, not {values!r}."
        )
    return make(values)


def drop_nan(splats: Splats) -> Splats:
    """Keep the splats without NaN or infinite values, which most formats cannot store.

    Args:
        splats: N splats; alphas of exactly 0 or 1 and scales of 0 are no reason to remove one.

    Raises:
        ModelError: No splat is left.
    """
    return apply(splats, [all_finite()])[0]


def crop_box(splats: Splats, low: Sequence[float], high: Sequence[float]) -> Splats:
    """Keep the splats whose centres are in an axis-aligned box, its faces included.

    Args:
        splats: N splats; those whose centre is not finite are removed.
        low: x, y, z of the lowest corner, scene units.
        high: x, y, z of the highest corner, scene units.

    Raises:
        OptionError: A corner is not three numbers, or low is above high.
        ModelError: No centre is in the box.
    """
    return apply(splats, [box(low, high)])[0]


def crop_sphere(splats: Splats, centre: Sequence[float], radius: float) -> Splats:
    """Keep the splats whose centres are in a ball, its surface included.

    Args:
        splats: N splats; those whose centre is not finite are removed.
        centre: x, y, z of the ball's centre, scene units.
        radius: Radius of the ball, scene units.

    Raises:
        OptionError: The centre is not three numbers, or the radius is not above 0.
        ModelError: No centre is in the ball.
    """
    return apply(splats, [sphere(centre, radius)])[0]


def min_opacity(splats: Splats, alpha: float) -> Splats:
    """Keep the splats whose alpha is not below a threshold; one whose alpha is NaN stays.

    Args:
        splats: N splats.
        alpha: The threshold, in [0, 1].

    Raises:
        OptionError: The threshold is not in [0, 1].
        ModelError: All splats are below it.
    """
    return apply(splats, [opaque_enough(alpha)])[0]


def drop_floaters(
    splats: Splats, *, neighbours: int = NEIGHBOURS, deviations: float = DEVIATIONS
) -> Splats:
    """Remove floaters: splats that are far from all others.

    A splat is a floater if the distance to its `neighbours`-th nearest neighbour, which is exact,
    is an outlier among those of the model and is more than three standard deviations of the splat's
    longest axis, so that the splat does not reach that neighbour either. An outlier is above the
    median by `deviations` times 1.4826 median absolute deviations. Both are of the logarithms of
    the distances, so that neither the scale of the scene nor the floaters themselves matter; the
    deviation counts as 0.3 at least. Distances of zero, between splats in the same place, are left
    out of these statistics. Isolated groups of up to `neighbours` splats are removed too, because
    the neighbour that counts is outside the group.

    Args:
        splats: N splats; those whose centre or scale is not finite stay and are no neighbours.
        neighbours: Rank of the neighbour whose distance counts, 1 or more.
        deviations: Number of deviations above the median from which a distance is an outlier, above
            0.

    Raises:
        OptionError: A parameter is out of range.
    """
    return apply(splats, [in_company(neighbours, deviations)])[0]


def all_finite() -> Filter:
    """Make the filter that `drop_nan` applies."""
    return Filter("drop-nan", "", Splats.finite, plain=("finite", ()))


def box(low: Sequence[float], high: Sequence[float]) -> Filter:
    """Make the filter that `crop_box` applies."""
    bottom, top = _point(low), _point(high)
    if (bottom > top).any():
        raise OptionError(
            "The lowest corner of a box must not be above the highest: give x0,y0,z0,x1,y1,z1."
        )

    def keep(splats: Splats) -> Bool:
        inside: Bool = np.all((splats.means >= bottom) & (splats.means <= top), axis=1)
        return inside

    text = "box:" + ",".join(map(exact_text, (*bottom, *top)))
    return Filter("crop", text, keep, plain=("box", (*bottom.tolist(), *top.tolist())))


def sphere(centre: Sequence[float], radius: float) -> Filter:
    """Make the filter that `crop_sphere` applies."""
    middle = _point(centre)
    if not (is_number(radius) and 0 < radius < math.inf):
        given = value_text(radius)
        raise OptionError(f"The radius of a sphere must be above 0 and finite, not {given}.")

    def keep(splats: Splats) -> Bool:
        inside: Bool = distances(splats.means, middle) <= radius
        return inside

    text = "sphere:" + ",".join(map(exact_text, (*middle, radius)))
    plain = ("sphere", (*middle.tolist(), float(radius)))
    return Filter("crop", text, keep, plain=plain)


def within(centre: Sequence[float], radius: float) -> Filter:
    """Make the filter that removes the environment: all splats beyond a distance from a point.

    Splats whose centre is not finite stay, so that they are dropped or refused with the model.
    """
    middle = _point(centre)
    plain = ("within", (*middle.tolist(), float(radius)))
    return Filter(ENVIRONMENT, "", lambda splats: ~_beyond(splats, middle, radius), plain=plain)


def beyond(centre: Sequence[float], radius: float) -> Filter:
    """Make the filter that keeps only the environment: the splats that `within` removes."""
    middle = _point(centre)
    plain = ("beyond", (*middle.tolist(), float(radius)))
    return Filter(ENVIRONMENT, "", lambda splats: _beyond(splats, middle, radius), plain=plain)


def _beyond(splats: Splats, middle: F64, radius: float) -> Bool:
    """Return an (N,) bool mask of the splats beyond a distance; false if it is not finite."""
    away = distances(splats.means, middle)
    beyond: Bool = (away > radius) & np.isfinite(away)
    return beyond


def distances(means: F, middle: F64) -> F64:
    """Compute the (N,) float64 distances of centres from a point; not finite if the centre is not.

    Args:
        means: (N, 3) centres, scene units.
        middle: (3,) the point, scene units.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        away: F64 = np.linalg.norm(means.astype(np.float64) - middle, axis=1)
    return away


def opaque_enough(alpha: float) -> Filter:
    """Make the filter that `min_opacity` applies."""
    if not (is_number(alpha) and 0 <= alpha <= 1):
        raise OptionError(f"The lowest opacity must be from 0 to 1, not {value_text(alpha)}.")
    return Filter(
        "min-opacity",
        exact_text(alpha),
        lambda splats: ~(splats.opacities() < alpha),
        plain=("opacity", (float(alpha),)),
    )


def in_company(neighbours: int = NEIGHBOURS, deviations: float = DEVIATIONS) -> Filter:
    """Make the filter that `drop_floaters` applies."""
    if not is_number(neighbours, whole=True):
        raise OptionError(f"The number of neighbours must be a whole number, not {neighbours!r}.")
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


def _in_company(neighbours: float, deviations: float) -> Filter:
    """Make the filter from its record, which holds the number of neighbours as a float."""
    whole = int(neighbours) if float(neighbours).is_integer() else neighbours
    return in_company(whole, deviations)  # type: ignore[arg-type]  # which refuses others


def _floaters(splats: Splats, neighbours: int, deviations: float) -> Bool:
    from nanogs.neighbours import nearest_neighbours

    found = np.zeros(len(splats), np.bool_)
    sizes = splats.scales().max(axis=1).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(splats.means).all(axis=1) & np.isfinite(sizes))
    means = splats.means[rows].astype(np.float64)
    if len(rows) < 2:
        return found
    nearest = nearest_neighbours(means, neighbours)
    with np.errstate(over="ignore"):  # squares of distances between float64 centres may overflow
        distances: F64 = np.linalg.norm(means[nearest[:, -1]] - means, axis=1)
    apart = np.log(distances[distances > 0])
    if len(apart):
        usual = float(np.median(apart))
        spread = max(1.4826 * float(np.median(np.abs(apart - usual))), _LEAST_SPREAD)
        with np.errstate(over="ignore"):  # beyond the range of float64 nothing is far
            far = distances > np.exp(usual + deviations * spread)
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
