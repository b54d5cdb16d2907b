"""Which way the small functions of the hottest kernels are compiled: decided here, for all of them.

Vectors are built with what Numba and llvmlite do not promise to keep. So they are taken where the
version of Numba is one that was tried, and only if they compile; the plain way, which is slower, is
taken elsewhere, and a line says so.
"""

import logging
import os
from enum import Enum
from functools import cache

import numba

from nanogs.errors import OptionError

VARIABLE = "NANOGS_SIMD"
FIRST, LAST = (0, 62), (0, 68)  # versions of Numba that were tried; see README.md
_log = logging.getLogger("nanogs")
_trying = False


class Way(Enum):
    """How the functions are compiled."""

    SIMD = "simd"  # from the vectors of this package
    PLAIN = "plain"  # by Numba, as they are written


def chosen() -> Way:
    """The way of this process; the same from the first call on."""
    return Way.SIMD if _trying else _chosen()[0]


def reason() -> str | None:
    """Why the plain way was taken although nobody asked for it, as one clause; or None."""
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
        "Slower kernels are used, which take some times as long: %s; %s=1 insists on the others.",
        why,
        VARIABLE,
    )
    return Way.PLAIN, why


def _untried(version: str) -> str | None:
    """A warning about a version of Numba that the vectors were not tried with."""
    major, minor, *_ = version.split(".")
    if FIRST <= (int(major), int(minor)) <= LAST:
        return None
    first, last = (".".join(map(str, one)) for one in (FIRST, LAST))
    return f"the fast ones were tried with Numba {first} to {last}, and this is {version}"


def _failure() -> str | None:
    """A warning if the vectors do not compile here; else they are kept on the disk."""
    global _trying  # noqa: PLW0603
    from nanogs.kernels.simd import trial

    _trying = True
    try:
        trial.run()
    except Exception as error:  # whatever a compiler that is unknown raises
        name = type(error).__name__
        return f"the fast ones do not compile with Numba {numba.__version__} here ({name})"
    finally:
        _trying = False
    return None
