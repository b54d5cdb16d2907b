"""Charts of PSNR over file size: one for the mean over scenes and one for each scene."""

from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING

from nanogs.bench.gains import score_on, views_of
from nanogs.bench.means import mean_rows, unique
from nanogs.bench.rows import ORIGINAL, BenchRow
from nanogs.charts import Chart, svg, tick_text, ticks
from nanogs.formatting import utf8

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ACROSS = "MB"
_INCHES = (6.4, 4.2)  # width and height of a chart in the PNG
_DOTS = 110  # per inch


class SizeCharts:
    """A grid of charts: for the mean and for each scene, one for each format and views with points.

    Attributes:
        charts: The charts, row by row.
        columns: Number of charts in a row.
    """

    def __init__(self, rows: Sequence[BenchRow]) -> None:
        """Collect the charts' points.

        Args:
            rows: From `run_bench` with file sizes.
        """
        columns = views_of([row for row in rows if row.format])  # the original has its own views
        scenes = unique(row.scene for row in rows)
        names = unique(row.method for row in rows if row.method != ORIGINAL)
        groups = {scene: [row for row in rows if row.scene == scene] for scene in scenes}
        if len(scenes) > 1:
            groups = _means(rows) | groups
        drawn = [
            [
                Chart(_title(name, *column), _ACROSS, lines)
                for column in columns
                if any((lines := _lines(group, names, *column)).values())
            ]
            for name, group in groups.items()
        ]
        self.charts = [chart for row in drawn for chart in row]
        self.columns = max(map(len, drawn), default=0)

    def svg(self) -> str:
        """Return all charts as one SVG element."""
        return svg(self.charts, self.columns)

    def png(self) -> bytes:
        """Return all charts as one PNG; needs matplotlib."""
        from matplotlib.figure import Figure

        down = -(-len(self.charts) // max(self.columns, 1))
        size = (_INCHES[0] * max(self.columns, 1), _INCHES[1] * max(down, 1))
        figure = Figure(figsize=size, dpi=_DOTS, layout="constrained")
        for place, chart in enumerate(self.charts):
            _draw(chart, figure.add_subplot(down, self.columns, place + 1))
        file = BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
        return file.getvalue()


def _means(rows: Sequence[BenchRow]) -> dict[str, list[BenchRow]]:
    """Return the means over scenes by title, apart for scenes with and without photographs."""
    kinds = unique(row.against for row in rows)
    groups = {}
    for against in kinds:
        means = mean_rows([row for row in rows if row.against == against])
        title = "mean over scenes" + (f" against {against}" if len(kinds) > 1 else "")
        groups[title] = [row for mean in means for row in mean.methods.values()]
    return groups


def _title(name: str, suffix: str, label: str) -> str:
    return ", ".join(part for part in (name, suffix, label) if part)


def _lines(
    rows: Sequence[BenchRow], names: Sequence[str], suffix: str, label: str
) -> dict[str, list[tuple[float, float]]]:
    """Return points (MB, PSNR) by method, in one order for all charts so that colours agree.

    The whole model in the format is a further entry, except for means, which have none.
    """
    lines: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for row in rows:
        score = score_on(row, label)
        if row.format == suffix and score is not None and row.file_bytes and score.psnr is not None:
            lines.setdefault(row.method, []).append((row.file_bytes / 1e6, score.psnr))
    return {name: sorted(points) for name, points in lines.items()}


def _draw(chart: Chart, axes: "Axes") -> None:
    for name, points in chart.lines.items():
        places = [[point[side] for point in points] for side in (0, 1)]
        axes.plot(*places, marker="o", markersize=4, label=_legible(name))
    axes.set_xscale("log")
    axes.set_xticks([], minor=True)
    axes.set_xticks(ticks(chart), [tick_text(value) for value in ticks(chart)])
    # A $ in a name must not start a formula.
    axes.set_title(_legible(chart.title), parse_math=False)
    axes.set(xlabel=chart.across, ylabel="PSNR (dB)")
    axes.grid(alpha=0.3)
    if chart.lines:
        for text in axes.legend(fontsize="small").get_texts():
            text.set_parse_math(False)


def _legible(name: str) -> str:
    """Escape lone surrogates in a name, because matplotlib refuses them."""
    return utf8(name).decode()
