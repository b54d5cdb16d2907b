"""Several models as one source, all with the same columns."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from nanogs.errors import ModelError, OptionError
from nanogs.formatting import counted
from nanogs.slices import overlapping
from nanogs.source.base import Layout, Source, joined_rows, refuse_no_source
from nanogs.splats import RenderMode, Splats, padded


class Joined(Source):
    """Several models as parts of one scene, concatenated.

    The columns are those that all have; coefficients that a part lacks are 0.

    Args:
        parts: One or more.
        layout: Layout that the parts are converted to; by default `joined_layout` of theirs. If its
            SH degree is lower than theirs, the bands above are left out.

    Raises:
        ModelError: The parts make no one scene.
    """

    def __init__(self, parts: Sequence[Source], layout: Layout | None = None) -> None:
        for part in parts:
            refuse_no_source(part)
        self._parts = parts
        self.columns = layout or joined_layout(parts)
        self._ends = [0, *accumulate(part.count for part in parts)]
        self.count = self._ends[-1]
        self.name = ", ".join(part.name for part in parts)

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; see `Source.read`."""
        found = [
            fitted(self._parts[number].read(low, high), self.columns)
            for number, low, high in overlapping(self._ends, start, stop)
        ]
        return joined_rows(found or [fitted(self._parts[0].read(0, 0), self.columns)])

    def load(self) -> Splats:
        """Read the whole model, with the notes of all parts."""
        splats = joined_rows([fitted(part.load(), self.columns) for part in self._parts])
        notes = dict.fromkeys([*self.columns.notes, *splats.notes])
        return replace(splats, notes=tuple(notes))

    def close(self) -> None:
        """Close all parts."""
        for part in self._parts:
            part.close()


def joined_layout(parts: Sequence[Source]) -> Layout:
    """Return the layout that parts of one scene are converted to.

    Raises:
        OptionError: There is no part.
        ModelError: They are for different renderers.
    """
    if not parts:
        raise OptionError("Give at least one file.")
    layouts = [part.columns for part in parts]
    modes = {layout.render_mode for layout in layouts}
    if len(modes) > 1:
        raise ModelError(
            f"The inputs have different render modes ({', '.join(sorted(map(str, modes)))}) and"
            " cannot form one scene; simplify them separately, or set one mode for all with"
            " `render_mode`."
        )
    columns = [dict(layout.extras) for layout in layouts]
    shared = {
        name: kind
        for name, kind in columns[0].items()
        if all(each.get(name) == kind for each in columns)
    }
    left = sorted({name for each in columns for name in each} - set(shared))
    notes = [f"Extra columns that not all inputs have are left out: {', '.join(left)}."] * any(left)
    if len({layout.sh_degree for layout in layouts}) > 1:
        notes.append("The inputs' SH degrees differ: coefficients that one lacks are 0.")
    if any(rows for part in parts for _, rows in part.elements):
        notes.append("Further elements of the inputs are left out: only their splats are kept.")
    others = {line for layout in layouts[1:] for line in layout.comments} - {*layouts[0].comments}
    if others:
        lines = counted(len(others), "comment line is", "comment lines are")
        notes.append(f"{lines} left out: of several inputs only the first one's are kept.")
    return Layout(
        sh_degree=max(layout.sh_degree for layout in layouts),
        double_means=any(layout.double_means for layout in layouts),
        extras=tuple(shared.items()),
        render_mode=layouts[0].render_mode,
        comments=layouts[0].comments,
        notes=tuple(notes),
    )


def fitted(splats: Splats, layout: Layout) -> Splats:
    """Convert splats to the columns and comments of a layout, without elements."""
    means = splats.means.astype(np.float64) if layout.double_means else splats.means
    cut = splats.with_sh_degree(layout.sh_degree)
    return Splats(
        means=means,
        log_scales=splats.log_scales,
        quats=splats.quats,
        opacity_logits=splats.opacity_logits,
        sh=padded(cut.sh, (layout.sh_degree + 1) ** 2),
        extras={name: splats.extras[name].astype(kind) for name, kind in layout.extras},
        render_mode=RenderMode(layout.render_mode),
        comments=layout.comments,
        notes=splats.notes,
    )
