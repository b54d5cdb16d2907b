"""The choice between vectors and plain code for the small functions of the hottest kernels.

The vectors use parts of Numba and llvmlite that may change in any version. So they are used only
with versions of Numba that were tested, and only if they compile; otherwise plain code is used,
which is slower, and a warning is logged.
"""

import logging
import os
from enum import Enum
from functools import cache

import numba

from nanogs.errors import OptionError

VARIABLE = "NANOGS_SIMD"
FIRST, LAST = (0, 62), (0, 68)  # versions of Numba that were tested; see README.md
_log = logging.getLogger("nanogs")
_trying = False


class Way(Enum):
    """The two ways of compiling the functions."""

    SIMD = "simd"  # as the vectors of this package
    PLAIN = "plain"  # by Numba, from the Python functions


def chosen() -> Way:
    """Return the way that this process uses, which never changes after the first call."""
    return Way.SIMD if _trying else _chosen()[0]


def reason() -> str | None:
    """Return why plain code is used although nobody asked for it, as one clause, or None."""
    return _chosen()[1]


@cache
def _chosen() -> tuple[Way, str | None]:
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "0", "1"):
        raise OptionError(f"{VARIABLE} must be 0, 1 or not set, not {asked!r}.")
    if asked:
        return (Way.SIMD if asked == "1" else Way.PLAIN), None
    why = _untried(numba.__version__) or _failure()
    if why is None:
        return Way.SIMD, None
    _log.warning(
        "Slower kernels are used, which take several times as long: %s; %s=1 forces the fast ones.",
        why,
        VARIABLE,
    )
    return Way.PLAIN, why


def _untried(version: str) -> str | None:
    """Return a warning if the vectors were not tested with this version of Numba, or None."""
    major, minor, *_ = version.split(".")
    if FIRST <= (int(major), int(minor)) <= LAST:
        return None
    first, last = (".".join(map(str, one)) for one in (FIRST, LAST))
    return f"the fast ones were tested with Numba {first} to {last}, and this is {version}"


def _failure() -> str | None:
    """Return a warning if the vectors do not compile here, or None; the trial is cached on disk."""
    global _trying  # noqa: PLW0603
    from nanogs.kernels.simd import trial

    _trying = True
    try:
        trial.run()
    except Exception as error:  # an untested compiler may raise anything
        name = type(error).__name__
        return f"the fast ones do not compile with Numba {numba.__version__} here ({name})"
    finally:
        _trying = False
    return None
