"""The default levels of detail."""

from nanogs.errors import OptionError

# Number of splats that viewers draw at once on a phone: Spark 2.2 draws 1,000,000 on Android and
# 1,500,000 on an iPhone (500,000 on a Quest, 2,500,000 on a computer), supersplat-viewer 1.36 one
# to two million on phones (two to four on computers).
PHONE = 1_000_000
# Number of times that the number of splats is halved.
FEWEST_HALVES, MOST_HALVES = 3, 16
# Viewers descend a tree from its root, so it needs coarser levels.
FEWEST_HALVES_OF_A_TREE = 6


def default_ratios(splats: int, *, tree: bool = False) -> tuple[float, ...]:
    """Return the default ratios: 1, 1/2, 1/4 and so on, down to what a phone draws at once.

    The last is at most an eighth, or a 64th for a tree, for models that are far away or one of
    many.

    Args:
        splats: Number of splats of the model.
        tree: Whether the levels become a tree, as in Spark's `.rad`.

    Raises:
        OptionError: The model has no splats.
    """
    if splats < 1:
        raise OptionError("A model without splats has no levels of detail; name another one.")
    least = FEWEST_HALVES_OF_A_TREE if tree else FEWEST_HALVES
    halves = max(least, (-(-splats // PHONE) - 1).bit_length())
    return tuple(0.5**half for half in range(min(halves, MOST_HALVES) + 1))
