"""Extension records of `.spz`, as further elements of a model.

A record is a number for its kind and some bytes (https://github.com/nianticlabs/spz,
extensions/README.md). Of one that nanogs does not know nobody can tell what the bytes are: they are
kept as they are, one row a byte. Where their count is a multiple of that of the splats they may
belong to single splats; such a record has one row a splat, so that a model of fewer splats refuses
to carry it on, as it does with elements of `.ply` files.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from nanogs.io.spz.header import CAMERA_RECORD, FRAME_RECORD, RECORD
from nanogs.splats import ExtraElement, Splats

_PREFIX = "spz_record_"
_BYTE = "byte"
_MOST_BYTES = 256  # of a record's share of a splat


def elements_of(records: Mapping[int, bytes], count: int) -> tuple[ExtraElement, ...]:
    """The records as elements, without that of the frame, which is told apart.

    Args:
        records: Payload by kind.
        count: Splats of the file.
    """
    kinds = [kind for kind in records if kind != FRAME_RECORD and records[kind]]
    return tuple(_element(kind, records[kind], count) for kind in kinds)


def _element(kind: int, payload: bytes, count: int) -> ExtraElement:
    width, rest = divmod(len(payload), count)
    whole = kind == CAMERA_RECORD or rest or count < 2 or not 1 <= width <= _MOST_BYTES
    names = [_BYTE] if whole else [f"{_BYTE}_{number}" for number in range(width)]
    rows = np.frombuffer(payload, [(name, "u1") for name in names])
    return ExtraElement(f"{_PREFIX}{kind:08X}", rows)


def is_record(element: ExtraElement) -> bool:
    """Whether an element is a record, its rows bytes, as `elements_of` makes them."""
    digits = element.name.removeprefix(_PREFIX)
    if digits == element.name or len(digits) != 8 or not set(digits) <= set("0123456789ABCDEF"):
        return False
    fields = element.rows.dtype.names or ()
    return all(element.rows.dtype[name] == np.uint8 for name in fields)


def without_records(splats: Splats) -> Splats:
    """The model without the elements that are records."""
    return replace(splats, elements=[each for each in splats.elements if not is_record(each)])


def of_splats(elements: Iterable[ExtraElement], count: int) -> bool:
    """Whether there is a record with a row for each of so many splats, which thus stay in order."""
    return any(is_record(each) and len(each.rows) == count for each in elements)


def packed(elements: Iterable[ExtraElement]) -> bytes:
    """The records among elements, one after the other as a file has them."""
    parts = []
    for each in elements:
        if is_record(each):
            payload = np.ascontiguousarray(each.rows).tobytes()
            kind = int(each.name.removeprefix(_PREFIX), 16)
            parts += [RECORD.pack(kind, len(payload)), payload]
    return b"".join(parts)
