"""The table of all formats, with their readers and writers; look them up through `registry`."""

from importlib import import_module

from nanogs.io.format import Format

FAMILIES = (
    "ply",
    "splat",
    "npz",
    "spz",
    "ksplat",
    "gltf",
    "sog",
    "rad",
    "lcc",
    "usda",
    "csv",
    "html",
    "checkpoint",
)
"""Modules and packages of `nanogs.io`, one for each family of formats; each defines `FORMATS`."""

FORMATS: tuple[Format, ...] = tuple(
    one for family in FAMILIES for one in import_module(f"nanogs.io.{family}").FORMATS
)
