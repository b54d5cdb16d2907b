"""A model in memory, as a source."""

from dataclasses import replace

import numpy as np

from nanogs._types import I64
from nanogs.source.base import Layout, Source
from nanogs.splats import ExtraElement, Splats, refuse_other


class InMemory(Source):
    """A model in memory, as a source; `read` returns views of it."""

    def __init__(self, splats: Splats) -> None:
        refuse_other(splats)
        self._splats, self.count = splats, len(splats)
        self.elements = tuple((element.name, len(element.rows)) for element in splats.elements)
        self.columns = Layout(
            sh_degree=splats.sh_degree,
            double_means=splats.means.dtype == np.float64,
            extras=tuple((name, column.dtype.str) for name, column in splats.extras.items()),
            render_mode=splats.render_mode.value,
            comments=tuple(splats.comments),
            notes=tuple(splats.notes),
        )

    def _span(self, start: int, stop: int) -> Splats:
        """Read rows `start` to `stop`; notes on the whole model are in `columns`."""
        return replace(self._splats.span(start, stop), notes=())

    def _take(self, rows: I64) -> Splats:
        """Read rows by number; see `Source.take`."""
        return replace(self._splats.take(rows), notes=())

    def read_elements(self) -> tuple[ExtraElement, ...]:
        """Return the elements of the model."""
        return tuple(self._splats.elements)

    def load(self) -> Splats:
        """Return the model itself."""
        return self._splats


def refuse_no_model(model: object) -> None:
    """Refuse an argument that is neither `Splats` nor a source.

    Raises:
        ModelError: It is neither.
    """
    if not isinstance(model, Source):
        refuse_other(model)


def source_of(model: Splats | Source) -> Source:
    """Return a model in memory as a source; a source is returned unchanged."""
    return InMemory(model) if isinstance(model, Splats) else model
