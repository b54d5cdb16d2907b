"""The table of all formats, with their readers and writers; look them up through `registry`.

A family is imported when one of its formats is needed: all of them take a fifteenth of the time in
which a command starts.
"""

from functools import cache
from importlib import import_module

from nanogs.io.format import Format

FAMILIES = {
    "ply": (".compressed.ply", ".ply"),
    "splat": (".splat",),
    "npz": (".npz",),
    "spz": (".spz",),
    "ksplat": (".ksplat",),
    "gltf": (".glb", ".gltf", "tileset.json"),
    "sog": (".sog", "meta.json", "lod-meta.json", ".ssog"),
    "rad": (".rad",),
    "lcc": (".lcc", ".lcc2"),
    "usda": (".usda",),
    "csv": (".csv",),
    "html": (".html",),
    "checkpoint": (".pt", ".ckpt", ".pth"),
}
"""Modules and packages of `nanogs.io`, one for each family of formats, with the suffixes of these.

Each defines `FORMATS`, in the same order.
"""


def of_family(family: str) -> tuple[Format, ...]:
    """Return the formats of one of `FAMILIES`."""
    found: tuple[Format, ...] = import_module(f"nanogs.io.{family}").FORMATS
    return found


@cache
def all_formats() -> tuple[Format, ...]:
    """Return all formats, family by family."""
    return tuple(known for family in FAMILIES for known in of_family(family))


def of_name(name: str) -> Format | None:
    """Return the format with the longest suffix of a file name in lower case; None if none is."""
    found = [
        (len(suffix), family, place)
        for family, suffixes in FAMILIES.items()
        for place, suffix in enumerate(suffixes)
        if name.endswith(suffix)
    ]
    if not found:
        return None
    _, family, place = max(found)
    return of_family(family)[place]
