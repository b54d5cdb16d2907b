"""Validation of values from models' JSON files; `where` names file and field in error messages.

Camera files have `datasets.fields`: there, messages show the value and say to export the cameras.
"""

import json
import math
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from nanogs._types import F64
from nanogs.errors import FormatError
from nanogs.io.files import input_size, reading

_TRAILING_COMMA = re.compile(rb'("(?:[^"\\]++|\\.)*+"?)|,(?=\s*+[}\]])', re.DOTALL)
_DEVICE = re.compile(r"(?i:con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³])")


def parse(data: bytes, where: str, *, trailing_commas: bool = False) -> dict[str, Any]:
    """Parse a JSON text and return its object as a `dict`.

    Args:
        data: The text.
        where: Names it in error messages.
        trailing_commas: Whether a comma may follow the last entry of an object or a list, as some
            programs write it.

    Raises:
        FormatError: It is not JSON in UTF-8, or is not an object.
    """
    try:
        value = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        if trailing_commas:  # a text without them is parsed at once, which is faster
            return parse(_TRAILING_COMMA.sub(rb"\1", data), where)
        raise FormatError(
            f"{where} is no JSON or is cut short ({error}); export or download the model again."
        ) from error
    return table(value, where)


def read_json(path: Path, limit: int, *, trailing_commas: bool = False) -> dict[str, Any]:
    """Read a small JSON file and return its object as a `dict`.

    Args:
        path: The file.
        limit: Largest allowed size in bytes.
        trailing_commas: As for `parse`.

    Raises:
        FormatError: It cannot be read, is larger, or is not a JSON object.
    """
    if input_size(path) > limit:
        raise refused(str(path), f"is too large for what it should hold, with over {limit:,} bytes")
    with reading(path) as file:
        return parse(file.read(limit), str(path), trailing_commas=trailing_commas)


def table(value: object, where: str) -> dict[str, Any]:
    """Return a JSON object, refusing anything else with a `FormatError`."""
    if not isinstance(value, dict):
        raise refused(where, "must be a JSON object")
    return value


def rows(value: object, where: str, length: int | None = None) -> list[Any]:
    """Return a list, of `length` entries if that is given, or raise a `FormatError`."""
    if not isinstance(value, list) or length not in (None, len(value)):
        count = "a list" if length is None else f"a list of {length}"
        raise refused(where, f"must be {count}")
    return value


def integer(value: object, where: str, least: int, most: int | None = None) -> int:
    """Return an integer from `least` to `most`, refusing anything else with a `FormatError`."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)  # JavaScript has only one type of number
    limit = math.inf if most is None else most
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= limit:
        up_to = "on" if most is None else f"to {most}"
        raise refused(where, f"must be an integer from {least} {up_to}")
    return value


def numbers(value: object, where: str, length: int) -> F64:
    """Return (length,) float64 numbers that are finite in float32, or raise a `FormatError`."""
    values = rows(value, where, length)
    limit = float(np.finfo(np.float32).max)
    for entry in values:
        plain = isinstance(entry, int | float) and not isinstance(entry, bool)
        if not plain or not abs(entry) <= limit:  # refuses NaN too
            raise refused(where, "must hold finite numbers")
    return np.array(values, np.float64)


def plain_name(value: object, where: str) -> str:
    """Return the name of a file in the same folder, refusing a path with a `FormatError`."""
    if not isinstance(value, str) or not is_plain(value):
        raise refused(where, "must name a file in the same folder")
    return value


def is_plain(name: str) -> bool:
    """Whether a name is a plain file name, and on no system a path, a drive or a device."""
    # Windows drops dots and spaces at the end, and opens a device whatever suffix its name has.
    device = _DEVICE.fullmatch(name.partition(".")[0].rstrip(" "))
    plain = name.isprintable() and not set(name) & set('/\\:*?"<>|')
    return plain and not name.endswith((".", " ")) and bool(name) and not device


def referenced_path(folder: Path, uri: object, where: str) -> Path:
    """Return the path that a relative URI names, which must be in a folder or below it.

    Args:
        folder: Folder of the file that contains the reference.
        uri: The reference; a query `?` and a fragment `#` are ignored.
        where: The file and the field, for the message.

    Raises:
        FormatError: It is not a text, or points outside the folder or to another machine.
    """
    plain = uri.partition("#")[0].partition("?")[0] if isinstance(uri, str) else ""
    parts = [part for part in unquote(plain).split("/") if part != "."]
    if not parts or not all(map(is_plain, parts)):
        raise refused(where, "must name a file in the same folder or below it")
    return folder.joinpath(*parts)


def refused(where: str, what: str) -> FormatError:
    """Build the error for a field, or a file of a model, that violates the format."""
    return FormatError(f"{where} {what}; export or download the model again.")
