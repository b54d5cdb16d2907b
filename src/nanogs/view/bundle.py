"""The viewer's JavaScript, which is bundled when the package is built (viewer/bundle.py)."""

from functools import cache
from typing import TYPE_CHECKING

from nanogs.errors import OptionError

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

_PROGRAM, _LICENCES = "viewer.js", "LICENSES.txt"


def is_built() -> bool:
    """Return whether this installation has the viewer."""
    return _file(_PROGRAM).is_file()


def check_built() -> None:
    """Fail early if the viewer is missing.

    Raises:
        OptionError: The viewer is missing; the message says what to do.
    """
    if not is_built():
        raise OptionError(
            "This installation was built without the viewer; install nanogs again with `pip install"
            " .` and without NANOGS_NO_VIEWER, where npm reaches its registry."
        )


@cache
def program() -> str:
    """Return the JavaScript, gzipped, as base64: a third of its size.

    Raises:
        OptionError: It was not built.
    """
    import base64
    import gzip

    check_built()
    plain = _file(_PROGRAM).read_bytes()
    return base64.b64encode(gzip.compress(plain, 9, mtime=0)).decode("ascii")


def licences() -> str:
    """Return the licences of the software in the JavaScript."""
    return _file(_LICENCES).read_text(encoding="utf-8")


def _file(name: str) -> "Traversable":
    from importlib.resources import files  # imported here because `compare --help` does not need it

    return files("nanogs.view").joinpath(name)
