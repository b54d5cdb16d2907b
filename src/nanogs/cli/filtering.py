"""Parsing of the options that filter splats, and messages about the splats removed."""

from collections.abc import Iterable

from nanogs import filters
from nanogs.cli.console import warn
from nanogs.cli.file_options import Edits
from nanogs.errors import OptionError
from nanogs.formatting import counted


def parse_filters(edits: Edits) -> list[filters.Filter]:
    """Parse the filters, in the order in which they are applied.

    Raises:
        OptionError: A filter is invalid.
    """
    regions = [_crop(text) for text in edits.crop or ()]
    return filters.in_order(
        regions, edits.min_opacity, floaters=edits.drop_floaters, nan=edits.drop_nan
    )


def _crop(text: str) -> filters.Filter:
    kind, _, rest = text.partition(":")
    try:
        numbers = [float(part) for part in rest.split(",")]
    except ValueError:
        numbers = []
    if kind == "box" and len(numbers) == 6:
        return filters.box(numbers[:3], numbers[3:])
    if kind == "sphere" and len(numbers) == 4:
        return filters.sphere(numbers[:3], numbers[3])
    raise OptionError(
        f"--crop must be box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,r with numbers, not {text!r}."
    )


def report_filters(reports: Iterable[filters.FilterReport]) -> None:
    """Print on stderr the number of splats that each filter removed."""
    for each in reports:
        left = counted(each.left, "is left", "are left")
        name = f"{each.name} {each.argument}".strip()
        warn(f"{name} removed {counted(each.removed, 'splat')}; {left}.")
