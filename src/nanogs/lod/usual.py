"""The levels that are made where nobody says which."""

from nanogs.errors import OptionError

# Splats that a viewer draws at once on a phone: Spark 2.2 takes 1,000,000 on Android and 1,500,000
# on an iPhone (500,000 on a Quest, 2,500,000 on a computer), supersplat-viewer 1.36 one to two
# million on phones (two to four on computers).
PHONE = 1_000_000
FEWEST_HALVES, MOST_HALVES = 3, 16
# A tree is walked down from its root, and so begins coarser.
FEWEST_HALVES_OF_A_TREE = 6


def usual_ratios(splats: int, *, tree: bool = False) -> tuple[float, ...]:
    """All splats, and halves of halves of them down to what a phone draws at once.

    There are an eighth at least, or a 64th where levels are a tree, for models far away and
    beside others.

    Args:
        splats: Of the model.
        tree: Whether the levels are a tree, as in Spark's `.rad`.

    Raises:
        OptionError: There are none.
    """
    if splats < 1:
        raise OptionError("A model without splats has no levels of detail; name another one.")
    least = FEWEST_HALVES_OF_A_TREE if tree else FEWEST_HALVES
    halves = max(least, (-(-splats // PHONE) - 1).bit_length())
    return tuple(0.5**half for half in range(min(halves, MOST_HALVES) + 1))
