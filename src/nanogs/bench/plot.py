"""PSNR against the compaction ratio, a line for each method."""

import math
from collections.abc import Sequence

from nanogs.bench.means import mean_rows, unique
from nanogs.bench.rows import BenchRow
from nanogs.charts import Chart, svg
from nanogs.formatting import counted


def plot(rows: Sequence[BenchRow]) -> str:
    """Draw means over scenes as SVG: a chart for photographs, one for views of the originals.

    Args:
        rows: From `run_bench`.
    """
    charts = []
    for against in unique(row.against for row in rows):
        scored = [row for row in rows if row.against == against]
        title = f"against {against}, mean over scenes"
        charts.append(Chart(title, f"compaction ratio{_scenes_text(scored)}", curves(scored)))
    return svg(charts)


def _scenes_text(rows: Sequence[BenchRow]) -> str:
    """Return the number of scenes at each ratio if they differ: lines then join different means."""
    means = [mean for mean in mean_rows(rows) if mean.scenes]
    found = {mean.target.ratio: mean.scenes for mean in means if mean.target.ratio}
    if len(set(found.values())) < 2:
        return ""
    counts = [f"{counted(len(found[ratio]), 'scene')} at {ratio:g}" for ratio in sorted(found)]
    return f"; means of {', '.join(counts)}"


def curves(rows: Sequence[BenchRow]) -> dict[str, list[tuple[float, float]]]:
    """Return points (ratio, mean PSNR) by method, ratios ascending, without infinite values.

    Args:
        rows: Rows scored against the same kind of images.
    """
    points: dict[str, list[tuple[float, float]]] = {}
    for mean in mean_rows(rows):
        for method, row in mean.methods.items():
            if mean.target.ratio and row.psnr is not None and math.isfinite(row.psnr):
                points.setdefault(method, []).append((mean.target.ratio, row.psnr))
    return {method: sorted(found) for method, found in points.items()}
