"""Packing models for the page: reduced to a number of splats that a browser can draw, quickly."""

from dataclasses import dataclass, replace
from secrets import token_hex
from typing import Any

import numpy as np

from nanogs._types import Bool
from nanogs.activations import base_colour
from nanogs.formatting import counted
from nanogs.splats import Splats
from nanogs.view.pack import pack
from nanogs.views.decimated import decimated
from nanogs.views.opening import Opening

MOST_SHOWN = 500_000  # most splats of a model that is sent to a page
_MAGENTA = (1.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Shown:
    """A model packed for the page.

    Attributes:
        entry: Description of it in an event.
        models: Its bytes, keyed by its ID.
    """

    entry: dict[str, Any]
    models: dict[str, bytes]


def show(splats: Splats, start: Opening, of: int) -> Shown:
    """Pack a model for the page, with a note if it replaces a model with more splats.

    Args:
        splats: The model, with at most `MOST_SHOWN` splats.
        start: The first camera of the page.
        of: Number of splats of the model that it replaces.
    """
    packed, name = pack(splats, start, quick=True), token_hex(8)
    notes = list(packed.notes)
    if of > len(splats):
        notes.insert(
            0,
            f"{counted(len(splats), 'splat')} are drawn in place of {of:,}, because a browser"
            " cannot draw more; numbers are those of the whole model.",
        )
    entry = {
        "id": name, "splats": len(splats), "of": of, "mip": packed.mip,
        "note": " ".join(notes) or None,
    }  # fmt: skip
    return Shown(entry, {name: packed.data})


def few(splats: Splats) -> Splats:
    """Reduce a model to `MOST_SHOWN` splats if it has more; those keep their harmonics."""
    if len(splats) <= MOST_SHOWN:
        return splats
    return decimated(splats, MOST_SHOWN, sh_degree=splats.sh_degree)


def marked(splats: Splats, stays: Bool) -> Splats:
    """Reduce a model as `few` does, and colour the splats that would be removed magenta.

    Args:
        splats: The whole model.
        stays: (N,) which of its splats remain.
    """
    shown = few(splats)
    every = -(-len(splats) // MOST_SHOWN)
    gone = ~stays[::every]
    sh = shown.sh.copy()
    sh[gone] = 0
    sh[gone, 0] = base_colour(np.array(_MAGENTA))
    return replace(shown, sh=sh)
