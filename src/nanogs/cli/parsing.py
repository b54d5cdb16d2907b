"""Parsing of the values of options and arguments that several commands share."""

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from nanogs.errors import OptionError
from nanogs.paths import suggested
from nanogs.quantities import MULTIPLES, multiple, parse_bytes

_LEAST_MEMORY = 10**6  # bytes; a smaller number was meant in another unit


class Direction(NamedTuple):
    """A direction in scene coordinates."""

    x: float
    y: float
    z: float


class Vector(NamedTuple):
    """Three numbers."""

    x: float
    y: float
    z: float


def parse_vector(text: object, option: str) -> Vector:
    """Parse three numbers from `x,y,z`; a default is returned as it is.

    Args:
        text: The value as typed, or the default.
        option: The option, for the message.

    Raises:
        OptionError: They are not three finite numbers.
    """
    if isinstance(text, Vector):
        return text
    try:
        x, y, z = (float(part) for part in str(text).split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise OptionError(f"{option} takes three finite numbers, such as 0,90,0, not {text!r}.")
    return Vector(x, y, z)


def parse_direction(text: str) -> Direction:
    """Parse a direction, that of --up, from `x,y,z`.

    Raises:
        OptionError: It is not three numbers, or all are zero.
    """
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise OptionError(f"--up takes three numbers like 0,-1,0, not {text!r}.") from None
    if x == y == z == 0 or not math.isfinite(x + y + z):
        raise OptionError(f"--up takes a direction, finite and not 0,0,0, but not {text!r}.")
    return Direction(x, y, z)


def parse_memory(text: str) -> int:
    """Parse an amount of memory to bytes, with `quantities.parse_bytes`.

    Raises:
        OptionError: It is not an amount of memory, or below a megabyte.
    """
    try:
        size = parse_bytes(text)
    except OptionError as error:
        raise OptionError(f"--max-memory {text}: {error}") from None
    if size < _LEAST_MEMORY:
        remedy = "name the unit too" if text.strip().isdigit() else "allow more"
        raise OptionError(
            f"--max-memory {text} is {size:,} B, too little for any model; {remedy}, as in"
            " --max-memory 4GB."
        )
    return size


def parse_count(text: str | int, option: str) -> int:
    """Parse a number of splats like `100000`, `100k` or `1.5M`; k, M and G are powers of 1000.

    Args:
        text: The value as typed, or the default.
        option: The option, for the message.

    Raises:
        OptionError: It is not such a number, or not a whole one.
    """
    value = multiple(str(text), MULTIPLES)
    if value is None or value.denominator != 1:
        raise OptionError(f"{option} takes a whole number like 100000, 100k or 1.5M, not {text!r}.")
    return int(value)


def parse_cameras(text: str) -> str:
    """Parse kinds of views, or the path of cameras, which are left as they are.

    Raises:
        OptionError: The text is empty, which as a path would be the current folder.
    """
    if not text.strip():
        raise OptionError("--cameras is empty; name a kind of views or a file, or leave it out.")
    return text


def parse_pixels(text: str) -> tuple[int, int]:
    """Parse width and height in pixels from `512` or `1280x720`.

    Raises:
        OptionError: It is neither, or not between 1 and 16384.
    """
    size = _size_of(text)
    if size is None:
        raise OptionError(f"--pixels must be like 512 or 1280x720, up to 16384, not {text!r}.")
    return size


def _size_of(text: str) -> tuple[int, int] | None:
    match = re.fullmatch(r"(\d+)(?:x(\d+))?", text.strip().lower())
    if match:
        width, height = int(match[1]), int(match[2] or match[1])
        if min(width, height) >= 1 and max(width, height) <= 16384:
            return width, height
    return None


def parse_sizes(text: str) -> list[tuple[int, int]]:
    """Parse widths and heights in pixels from sizes separated by commas, like `512,1280x720`.

    Raises:
        OptionError: One of them is not a size.
    """
    sizes = []
    for part in text.split(","):
        size = _size_of(part)
        if size is None:
            raise OptionError(
                f"Sizes of views are like 512,1280x720, up to 16384 pixels, not {part.strip()!r}."
            )
        sizes.append(size)
    return sizes


def parse_list(text: str) -> list[str]:
    """Split a text at commas; blanks around the parts, and empty parts, are left out."""
    return [part.strip() for part in text.split(",") if part.strip()]


def parse_packed(text: str | None, of_format: dict[str, Any]) -> list[str]:
    """Parse suffixes of formats separated by commas; [] for None: the option is not given.

    Raises:
        OptionError: The option names no format, or options of a format are given without it.
    """
    if text is None and of_format:
        option = next(iter(of_format)).replace("_", "-")
        raise OptionError(
            f"--{option} works only with --packed; name formats, as in --packed .sog."
        )
    return _parse_names(text, "--packed", "format", ".sog,.spz")


def parse_metrics(text: str | None) -> list[str]:
    """Parse names of metrics separated by commas; [] for None: the option is not given.

    Raises:
        OptionError: The option names none.
    """
    return _parse_names(text, "--metrics", "metric", "flip,lpips")


def _parse_names(text: str | None, option: str, what: str, example: str) -> list[str]:
    names = parse_list(text or "")
    if text is not None and not names:
        raise OptionError(f"{option} names no {what}; write it as in {option} {example}.")
    return names


def parse_ratio(text: str, option: str) -> float:
    """Parse a ratio like `0.1` or `10%`.

    Args:
        text: The value as typed.
        option: The option, for the message.

    Raises:
        OptionError: It is neither, or above 100%.
    """
    from fractions import Fraction

    number = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d{1,3})?"
    match = re.fullmatch(rf"({number})\s*(%?)", text.strip().lower())
    ratio = Fraction(match[1]) / (100 if match[2] else 1) if match else None
    if ratio is None or ratio > sys.float_info.max:
        raise OptionError(f"{option} takes a number like 0.1 or 10%, not {text!r}.")
    if match and match[2] and ratio > 1:
        raise OptionError(f"{option} takes 100% or less, not {text!r}.")
    return float(ratio)


def parse_ratios(text: str) -> tuple[float, ...]:
    """Parse the ratios of --levels, like `0.5,0.25,0.1` or `50%,25%,10%`.

    Raises:
        OptionError: One of them is not a ratio.
    """
    try:
        return tuple(parse_ratio(part, "--levels") for part in text.split(","))
    except OptionError:
        raise OptionError(
            f"Levels must be ratios up to 1, separated by commas, like 0.5,0.1, not {text!r}."
        ) from None


def parse_background(text: str) -> tuple[float, float, float]:
    """Parse `black`, `white` or `#rrggbb` to RGB in [0, 1].

    Raises:
        OptionError: It is none of these.
    """
    named = {"black": "#000000", "white": "#ffffff"}.get(text.lower(), text)
    match = re.fullmatch(r"#?([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})", named)
    if not match:
        raise OptionError(f"The background must be black, white or #rrggbb, not {text!r}.")
    red, green, blue = (int(part, 16) / 255 for part in match.groups())
    return red, green, blue


def parse_path(text: str | Path) -> Path:
    """Parse a path or URL; a URL is an `Address`, because `Path` would merge its slashes."""
    from nanogs.io.urls import as_path

    return as_path(text)


def parse_local(text: str | Path) -> Path:
    """Parse the path of a file or folder of this machine.

    Raises:
        OptionError: It is a URL.
    """
    from nanogs.io.urls import local_path

    return local_path(text)


def parse_model(text: str | Path) -> Path:
    """Parse the path or URL of a model, for a command that does not read stdin.

    Raises:
        OptionError: It is `-`.
    """
    return _no_dash(text, "does not read stdin; put the model in a file, and name it")


def parse_output(text: str | Path) -> Path:
    """Parse the path or URL of an output, for a command that does not write to stdout.

    Raises:
        OptionError: It is `-`.
    """
    return _no_dash(text, "does not write to stdout; name a file or folder")


def _no_dash(text: str | Path, instead: str) -> Path:
    if str(text) == "-":
        raise OptionError(f"This command {instead}.")
    return parse_path(text)


def parse_page(text: str | Path) -> Path:
    """Parse the path of a page.

    Raises:
        OptionError: Its suffix is not .html, or it is a URL.
    """
    page = parse_local(text)
    if page.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"{page}: pages are written as HTML; name {suggested(page, '.html')}.")
    return page


def parse_named(texts: Sequence[str]) -> list[tuple[str, Path]]:
    """Parse names and paths or URLs, each from `name=path`; without a name, the file's is taken.

    Of files with the same name, it has as many folders as tell them apart.
    """
    from nanogs.io.urls import short_names

    found = [_named(text) for text in texts]
    short = iter(short_names([path for name, path in found if name is None]))
    return [(next(short) if name is None else name, path) for name, path in found]


def _named(text: str) -> tuple[str | None, Path]:
    from nanogs.io.urls import is_url
    from nanogs.paths import exists

    name, separator, path = text.partition("=")
    if separator and name and not is_url(text) and not exists(text):
        return name, parse_model(path)
    return None, parse_model(text)
