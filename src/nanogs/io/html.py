"""Writing an `.html` page that shows the model offline, moved by mouse, touch and keys.

It is the page of `nanogs view`, which contains the model as `.spz` and the viewer that draws it.
"""

from typing import BinaryIO

from nanogs.io import limits
from nanogs.io.format import Format, unread
from nanogs.splats import RenderMode, Splats

SUFFIX = ".html"
RANGE_OF = ".spz, in which pages show models"  # whose range clamps values, for messages
_MAX_DEGREE = 3  # highest SH degree that the viewer draws


def check() -> None:
    """Fail before any computing if the viewer is missing.

    Raises:
        OptionError: This installation has no viewer.
    """
    from nanogs.view.bundle import check_built

    check_built()


def write(splats: Splats, file: BinaryIO) -> None:
    """Write the page.

    Raises:
        OptionError: This installation has no viewer.
        OutputError: There is no splat, or one holds values that are not finite.
        ModelError: The model is too large for a browser.
    """
    # Imported here: looking up a format must not import the code that makes pages.
    from nanogs.view.pack import pack
    from nanogs.view.page import Shown, facts_of, render_page
    from nanogs.views.opening import opening_for

    check()
    limits.refuse_unstorable(splats, SUFFIX)
    start = opening_for(splats)
    packed = pack(splats, start)
    # Neither a stream nor a file that is renamed has a name to write here: the page finds its own.
    shown = Shown("", facts_of(len(splats), len(packed.data)), packed)
    file.write(render_page([shown], start, (0.0, 0.0, 0.0)).encode("utf-8"))


def shown(splats: Splats) -> Splats:
    """Return a model as its page shows it, in scene units: read back from the .spz in the page.

    Raises:
        ModelError: No splat is visible.
    """
    from nanogs.view.pack import pack, unpack
    from nanogs.views.opening import opening_for

    start = opening_for(splats)
    return unpack(pack(splats, start, quick=True), start)


def _overhead_bytes() -> int:
    """Return the number of bytes that the viewer takes in a page."""
    from nanogs.view.bundle import licences, program

    return len(program()) + len(licences().encode("utf-8"))


def losses(splats: Splats) -> tuple[str, ...]:
    """Name the parts of a model that the page does not show or clamps, one sentence each.

    Splats that the page moves because they are far away, and scales that it clamps at 47 times the
    first distance, are not named: which these are depends on the first view of the whole model, and
    this may be some of its rows.
    """
    from nanogs.io.spz.unstorable import clamped_colours

    found = limits.left_out(splats, SUFFIX, max_degree=_MAX_DEGREE)
    found += limits.lost_mode(splats, SUFFIX, RenderMode.MIP)
    # The page holds an .spz in units of its own, in which the other ranges have this distance.
    return (*found, *clamped_colours(splats.with_sh_degree(_MAX_DEGREE), RANGE_OF))


FORMATS = (
    Format(
        SUFFIX,
        unread,
        write,
        overhead_bytes=_overhead_bytes,
        losses=losses,
        shown=shown,
        max_degree=_MAX_DEGREE,
        check=check,
        rounds=True,
    ),
)
