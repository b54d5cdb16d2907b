"""Conversion of the user's target to an exact count. No Numba here: `--dry-run` uses it too."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from nanogs.errors import OptionError, TooManyError, TooSmallError
from nanogs.formatting import counted
from nanogs.io import registry
from nanogs.io.format import Format, FormatOptions, Sharing
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.options.presets import Parameters, renders
from nanogs.ranges import is_number
from nanogs.splats import Splats

# Least steps, each on another view, of a fit that a result of a known count is rounded by: after
# fewer it is not known what shows elsewhere; see docs/method.md, "Rounding".
ROUNDED_STEPS = 20

_KINDS = {"count": int, "size": int, "ratio": float, "psnr": float, "draw_cost": float}


@dataclass(frozen=True, slots=True)
class Goal:
    """The target of a simplification: exactly one of five.

    Attributes:
        ratio: Compaction ratio in (0, 1].
        count: Number of splats.
        size: Largest size of the file, bytes.
        psnr: What the result must reach on views of the original, dB.
        draw_cost: Most that it may take to draw, as a share of the original's splats a pixel.

    Raises:
        OptionError: Not exactly one is given, or it is out of its range.
    """

    ratio: float | None = None
    count: int | None = None
    size: int | None = None
    psnr: float | None = None
    draw_cost: float | None = None

    def __post_init__(self) -> None:
        """Refuse none, several, and invalid values; NumPy's numbers become Python's."""
        self._make_plain()
        wishes = self.ratio, self.count, self.size, self.psnr, self.draw_cost
        if sum(wish is not None for wish in wishes) != 1:
            raise OptionError("Give exactly one of `ratio`, `count`, `size`, `psnr`, `draw_cost`.")
        if self.ratio is not None and not 0 < self.ratio <= 1:
            raise OptionError(
                f"The ratio must be above 0 and at most 1, not {self.ratio:g}{_share(self.ratio)}."
            )
        if self.count is not None and self.count < 1:
            raise OptionError(f"The count must be at least 1, not {self.count}.")
        if self.size is not None and self.size < 1:
            raise OptionError(f"The size must be at least 1 byte, not {self.size}.")
        if self.psnr is not None and not 0 < self.psnr < math.inf:
            raise OptionError(f"The PSNR must be above 0 dB and finite, not {self.psnr:g}.")
        if self.draw_cost is not None and not 0 < self.draw_cost <= 1:
            raise OptionError(
                f"The draw cost is a share above 0 and at most 1, not {self.draw_cost:g}"
                f"{_share(self.draw_cost)}."
            )

    def _make_plain(self) -> None:
        """Convert NumPy's numbers to Python's; single precision by the digits that it shows.

        Raises:
            OptionError: A value is no number, or not a whole one where it has to be.
        """
        for name, kind in _KINDS.items():
            value = getattr(self, name)
            if value is None:
                continue
            if not is_number(value, whole=kind is int):
                wanted = f"The {name} must be a whole" if kind is int else f"`{name}` must be a"
                raise OptionError(f"{wanted} number, not {value!r}.")
            digits = kind is float and hasattr(value, "dtype")  # 0.1 in float32 is a little more
            object.__setattr__(self, name, kind(str(value) if digits else value))

    @property
    def is_measured(self) -> bool:
        """Whether results must be measured to find the count, for any format."""
        return self.psnr is not None or self.draw_cost is not None

    @property
    def reported(self) -> dict[str, Any]:
        """The fields of `SimplifyReport` for it; the count that meets it is reported as well."""
        return {
            "asked_ratio": self.ratio,
            "asked_size": self.size,
            "asked_psnr": self.psnr,
            "asked_draw_cost": self.draw_cost,
        }

    def known_count(self, available: int) -> int | None:
        """Return the splats to deliver by a ratio or a count; None if a search has to find it.

        Args:
            available: Number of usable splats.

        Raises:
            OptionError: It is more than the model has.
        """
        if self.is_measured or self.size is not None:
            return None
        return target_count(available, self.ratio, self.count)


def _share(given: float) -> str:
    """Return what a number above 1 is as a share if it was meant in percent, to be appended."""
    return f" ({given:g} percent are {given / 100:g})" if 1 < given <= 100 else ""


def chooses_packing(goal: Goal, known: Format) -> bool:
    """Whether results are made to choose how the file is packed, for a size or a PSNR."""
    return (goal.size is not None or goal.psnr is not None) and known.file_bytes is None


def shared_in_file(goal: Goal, known: Format, options: FormatOptions) -> Sharing | None:
    """Return how splats will share harmonics in the file of a result, for it to be fitted so.

    None if each has its own, or if the search for a size or a PSNR decides.

    Args:
        goal: What is asked.
        known: The format of the file.
        options: Options that it will be written with, those that are given.
    """
    return None if chooses_packing(goal, known) else known.sharing_with(options)


def is_searched(goal: Goal, known: Format, *, degree: int, looks: bool) -> bool:
    """Whether the count can be found only by trying.

    Args:
        goal: What is asked.
        known: The format of the file.
        degree: Of the harmonics, as far as they may be chosen; 0 if they may not.
        looks: Whether results are made by what views show.
    """
    if goal.size is None:
        return goal.is_measured
    chosen = looks and known.readable and min(degree, known.max_degree) > 0
    return chooses_packing(goal, known) or chosen


def target_of(
    goal: Goal,
    splats: Splats,
    available: int,
    path: Path,
    chosen: Parameters,
    sh_degree: int | None,
) -> int | None:
    """Return the count that meets the goal, or None if it has to be searched for.

    Args:
        goal: The target of the simplification.
        splats: The model.
        available: Number of its usable splats.
        path: The output file; only its suffix counts.
        chosen: Parameters of the method.
        sh_degree: Degree of the result's harmonics, if one is asked for.

    Raises:
        OptionError: The goal cannot be met with this model or in this format.
    """
    if goal.size is None:
        return goal.known_count(available)
    known = registry.writable(path)
    if known.file_bytes is None:
        return None
    file_bytes = known.file_bytes
    like = splats if sh_degree is None else splats.with_sh_degree(sh_degree)
    degree = splats.sh_degree if sh_degree is None else 0
    searched = is_searched(goal, known, degree=degree, looks=renders(chosen))
    if searched and file_bytes(like, available) > goal.size:
        return None
    return count_for_size(available, goal.size, lambda count: file_bytes(like, count))


def target_count(available: int, ratio: float | None, count: int | None) -> int:
    """Return the number of splats to deliver: the count, or ceil(ratio x available).

    The ratio is taken as the decimal that is written, so that 0.07 of 100 is 7 and not 8.

    Args:
        available: Number of usable splats.
        ratio: Compaction ratio in (0, 1], or None.
        count: Number of splats, or None.

    Raises:
        OptionError: Not exactly one of both is given, or it is out of range.
        TooManyError: The count is above the usable splats.
    """
    goal = Goal(ratio=ratio, count=count)
    if (count := goal.count) is None:
        return math.ceil(Fraction(str(goal.ratio)) * available)
    if count > available:
        raise TooManyError(
            f"The count {count:,} is above the {counted(available, 'usable splat')} of the input; "
            "ask for at most as many."
        )
    return count


def count_for_size(available: int, size: int, file_bytes: Callable[[int], int]) -> int:
    """Find the largest count whose file is no larger than asked, at most `available`.

    Args:
        available: Number of usable splats.
        size: Bytes.
        file_bytes: Size of the file for a count; never smaller for a larger count.

    Raises:
        TooSmallError: Not even one splat fits.
    """
    smallest = file_bytes(1)
    if size < smallest:
        raise TooSmallError(
            f"The size {size:,} B is too small: a file of one splat of this model takes "
            f"{smallest:,} B; allow more."
        )
    fits, too_many = 1, available + 1
    while too_many - fits > 1:
        middle = (fits + too_many) // 2
        if file_bytes(middle) <= size:
            fits = middle
        else:
            too_many = middle
    return fits


def rounds_for_file(chosen: Parameters, known: Format | None) -> bool:
    """Return whether results of known counts are rounded so that their files pack well.

    Args:
        chosen: Parameters of the method.
        known: Format of the files; None if each holds a part of a result.
    """
    fitted = isinstance(chosen, ForestParameters) and chosen.steps >= ROUNDED_STEPS
    return fitted and known is not None and known.quantisation is not None
