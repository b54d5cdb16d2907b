"""The end of a request for a file size whose format has files of known sizes."""

from collections.abc import Callable

from nanogs.io.format import Sizer
from nanogs.pipeline.search.file_size import Reported, with_ending_on_known
from nanogs.splats import Splats


def with_size_ending(
    found: Reported,
    size: int,
    sizer: Sizer | None,
    counts: tuple[int, int],
    written: Callable[[], Splats],
    *,
    degree: int,
) -> Reported:
    """Add why the count is the largest that fits.

    If a size is only known by writing the file, the search for it has reported this already.

    Args:
        found: The result or its report.
        size: Largest allowed size of the file in bytes.
        sizer: Computes the size of a file; None if it is only known by writing the file.
        counts: Numbers of splats of the result, and of the usable ones of the model.
        written: Returns splats with the columns of the file; called with a sizer only.
        degree: SH degree of the model.
    """
    if sizer is None:
        return found
    like, (count, usable) = written(), counts
    return with_ending_on_known(
        found,
        size,
        count,
        usable,
        lambda other: sizer(like, other),
        left_out=like.sh_degree < degree,
    )
