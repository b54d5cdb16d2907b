"""PSNR against the compaction ratio, a line for each method."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.bench.means import mean_rows, unique
from nanogs.bench.rows import BenchRow
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curve = tuple[list[float], list[float]]


def save_plot(rows: Sequence[BenchRow], path: str | Path) -> None:
    """Draw the means over scenes and save them.

    Args:
        rows: From `run_bench`.
        path: .png or .svg.

    Raises:
        OptionError: The suffix is another one.
    """
    path = Path(path)
    if path.suffix not in (".png", ".svg"):
        raise OptionError(f"A plot is saved as .png or .svg, not {path.suffix!r}.")
    figure(rows).savefig(path, dpi=150)


def figure(rows: Sequence[BenchRow]) -> "Figure":
    """The plot; one panel for photographs and one for views of the original models."""
    from matplotlib.figure import Figure

    groups = unique(row.against for row in rows)
    drawing = Figure(figsize=(6.5 * max(len(groups), 1), 4.5), layout="constrained")
    for position, against in enumerate(groups, start=1):
        axes = drawing.add_subplot(1, len(groups), position)
        group = [row for row in rows if row.against == against]
        for method, (ratios, values) in curves(group).items():
            axes.plot(ratios, values, marker="o", label=method)
        axes.set_xscale("log")
        axes.set_xlabel("compaction ratio")
        axes.set_ylabel("PSNR (dB)")
        axes.set_title(f"against {against}, mean over scenes")
        axes.grid(visible=True, alpha=0.3)
        if axes.lines:
            axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1, 1))
    return drawing


def curves(rows: Sequence[BenchRow]) -> dict[str, Curve]:
    """Ratios and mean PSNR by method, ratios ascending; what is infinite cannot be drawn.

    Args:
        rows: Rows that are held against the same kind of images.
    """
    points: dict[str, list[tuple[float, float]]] = {}
    for mean in mean_rows(rows):
        for method, row in mean.methods.items():
            if row.psnr is not None and math.isfinite(row.psnr):
                points.setdefault(method, []).append((mean.ratio, row.psnr))
    return {
        method: ([ratio for ratio, _ in sorted(found)], [value for _, value in sorted(found)])
        for method, found in points.items()
    }
