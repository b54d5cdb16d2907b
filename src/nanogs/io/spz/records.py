"""Extension records of `.spz`, represented as extra elements of a model.

A record is a type number and some bytes (https://github.com/nianticlabs/spz, extensions/README.md).
The bytes of an unknown type cannot be interpreted: they are kept unchanged, one byte per row. If
their number is a multiple of the number of splats, they may be data per splat; such a record gets
one row per splat, so that it is not carried over to a model with fewer splats, as with elements of
`.ply` files.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from nanogs.io.spz.header import CAMERA_RECORD, FRAME_RECORD, RECORD
from nanogs.splats import ExtraElement, Splats

_PREFIX = "spz_record_"
_BYTE = "byte"
_MOST_BYTES = 256  # most bytes per splat for which a record counts as data per splat


def elements_of(records: Mapping[int, bytes], count: int) -> tuple[ExtraElement, ...]:
    """Convert records to elements, except that of the coordinate frame, which is read separately.

    Args:
        records: Payloads by type number.
        count: Number of splats in the file.
    """
    kinds = [kind for kind in records if kind != FRAME_RECORD]
    return tuple(_element(kind, records[kind], count) for kind in kinds)


def _element(kind: int, payload: bytes, count: int) -> ExtraElement:
    width, rest = divmod(len(payload), count)
    whole = kind == CAMERA_RECORD or rest or count < 2 or not 1 <= width <= _MOST_BYTES
    names = [_BYTE] if whole else [f"{_BYTE}_{number}" for number in range(width)]
    rows = np.frombuffer(payload, [(name, "u1") for name in names])
    return ExtraElement(f"{_PREFIX}{kind:08X}", rows)


def is_record(element: ExtraElement) -> bool:
    """Return whether an element is a record as `elements_of` makes it, by its name and fields."""
    fields = element.rows.dtype.names or ()
    bytes_only = all(element.rows.dtype[name] == np.uint8 for name in fields)
    return bytes_only and is_record_name(element.name)


def is_record_name(name: str) -> bool:
    """Return whether an element of this name may be a record; see `is_record`."""
    digits = name.removeprefix(_PREFIX)
    return digits != name and len(digits) == 8 and set(digits) <= set("0123456789ABCDEF")


def without_records(splats: Splats) -> Splats:
    """Return the model without the elements that are records."""
    return replace(splats, elements=[each for each in splats.elements if not is_record(each)])


def has_per_splat_record(elements: Iterable[ExtraElement], count: int) -> bool:
    """Return whether any record has one row per splat, so that splats must keep their order."""
    return any(is_record(each) and len(each.rows) == count for each in elements)


def packed(elements: Iterable[ExtraElement]) -> bytes:
    """Encode the elements that are records as the bytes of the file's extension records."""
    parts = []
    for each in elements:
        if is_record(each):
            payload = np.ascontiguousarray(each.rows).tobytes()
            kind = int(each.name.removeprefix(_PREFIX), 16)
            parts += [RECORD.pack(kind, len(payload)), payload]
    return b"".join(parts)
