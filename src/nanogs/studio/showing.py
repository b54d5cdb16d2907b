"""Models as the page gets them: few enough splats for a browser to draw, packed in no time."""

from dataclasses import dataclass, replace
from secrets import token_hex
from typing import Any

import numpy as np

from nanogs._types import Bool
from nanogs.formatting import counted
from nanogs.splats import Splats
from nanogs.stored import SH_C0
from nanogs.view.pack import pack
from nanogs.views.opening import Opening
from nanogs.views.stand_in import stand_in

MOST_SHOWN = 500_000  # splats
_MAGENTA = (1.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Shown:
    """A model for the page.

    Attributes:
        entry: What an event says of it.
        models: Its bytes by its ID.
    """

    entry: dict[str, Any]
    models: dict[str, bytes]


def show(splats: Splats, start: Opening, of: int) -> Shown:
    """Pack a model; a note says where it stands for one of more splats.

    Args:
        splats: The model, of at most `MOST_SHOWN` splats.
        start: Where the page begins.
        of: Splats of what it stands for.
    """
    packed, name = pack(splats, start, quick=True), token_hex(8)
    notes = list(packed.notes)
    if of > len(splats):
        notes.insert(
            0,
            f"{counted(len(splats), 'splat')} stand for {of:,}, as a browser draws no more;"
            " numbers are of the whole model.",
        )
    entry = {
        "id": name, "splats": len(splats), "mip": packed.mip, "note": " ".join(notes) or None,
    }  # fmt: skip
    return Shown(entry, {name: packed.data})


def few(splats: Splats) -> Splats:
    """The model, or one that stands for it and that a browser draws."""
    return splats if len(splats) <= MOST_SHOWN else stand_in(splats, MOST_SHOWN)


def marked(splats: Splats, stays: Bool) -> Splats:
    """A model as `few` gives it, with what does not stay in magenta.

    Args:
        splats: The whole model.
        stays: (N,) which of its splats stay.
    """
    shown = few(splats)
    every = -(-len(splats) // MOST_SHOWN)
    gone = ~stays[::every]
    sh = shown.sh.copy()
    sh[gone] = 0
    sh[gone, 0] = (np.array(_MAGENTA) - 0.5) / SH_C0
    return replace(shown, sh=sh)
