"""The table of gains at equal file size, and the HTML page of a run with file sizes."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from nanogs.bench.gains import Gain, MeanGain, mean_gains, score_on
from nanogs.bench.means import unique
from nanogs.bench.rows import BenchRow, Status
from nanogs.bench.size_charts import SizeCharts
from nanogs.charts import narrow_svg
from nanogs.formatting import NONE, counted, number_text
from nanogs.templates import template

TITLE = "Gain at equal size"
ALONE = "A gain is that of one method over another, and only one was measured."
LEGEND = (
    "Differences of curves, averaged over the sizes that both cover (Bjontegaard, piecewise cubic"
    " over the logarithm of the bytes), then over scenes: BD-PSNR in dB, in brackets the smallest"
    " of any scene; BD-SSIM; BD-rate, the change in bytes at equal PSNR, so that -50 % saves half,"
    " with the number of scenes if some have none. Against several methods: against the best of"
    " them at each size, separately for PSNR and SSIM."
)


@dataclass(frozen=True, slots=True)
class Table:
    """A table as text.

    Attributes:
        head: Names of the columns.
        rows: Cells, row by row.
        left: Number of columns on the left that hold words; the others hold numbers.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: int


def gain_table(gains: Sequence[MeanGain]) -> Table:
    """Return a table with a row for each method, anchor, format and kind of views.

    Args:
        gains: From `mean_gains`.
    """
    head = ("method", "against", "format", "views", "BD-PSNR", "BD-SSIM", "BD-rate", "scenes")
    return Table(head, [_cells(gain) for gain in gains], left=4)


def _cells(gain: MeanGain) -> list[str]:
    psnr = NONE if gain.psnr is None else f"{gain.psnr:+.2f} ({gain.least_psnr:+.2f})"
    ssim = NONE if gain.ssim is None else f"{gain.ssim:+.3f}"
    rate = NONE if gain.rate is None else f"{100 * gain.rate:+.0f} %"
    scenes = sum(one.psnr is not None for one in gain.gains)
    rated = sum(one.rate is not None for one in gain.gains)
    if 0 < rated < scenes:
        rate += f" (of {rated})"
    first = gain.first
    names = [first.method, first.anchor, first.format, first.label or "photographs"]
    return [*names, psnr, ssim, rate, str(scenes)]


def gain_remarks(gains: Sequence[MeanGain]) -> list[str]:
    """Return sentences that list the scenes without a figure and the reason."""
    by_text: dict[str, list[str]] = {}
    for one in (one for gain in gains for one in gain.gains):
        for remark in one.remarks:
            by_text.setdefault(f"{_pair(one)}: {remark}", []).append(one.scene)
    return [f"{text} ({', '.join(unique(scenes))})." for text, scenes in by_text.items()]


def _pair(gain: Gain) -> str:
    views = f", {gain.label}" if gain.label else ""
    return f"{gain.method} against {gain.anchor}, {gain.format}{views}"


def size_page(rows: Sequence[BenchRow], others: Sequence[str], preamble: str) -> str:
    """Return a self-contained HTML page, without network access: gains, charts and all files.

    Args:
        rows: From `run_bench` with file sizes.
        others: As for `mean_gains`.
        preamble: How they were made, as text.
    """
    from markupsafe import Markup

    gains = mean_gains(rows, others)
    return template("nanogs.bench", "sizes.html.j2").render(
        title=TITLE,
        preamble=Markup(_wrappable(preamble.replace("```\n", "").strip())),  # noqa: S704
        legend=LEGEND if gains else ALONE,
        gains=gain_table(gains),
        remarks=gain_remarks(gains),
        # One SVG for each chart, so that they fit a phone; `narrow_svg` escapes their text.
        charts=[
            (chart.title, Markup(narrow_svg(chart)))  # noqa: S704
            for chart in SizeCharts(rows).charts
        ],
        files=file_table(rows),
        left_out=[
            f"{row.scene}, {row.method} at {row.target.text}: {row.status}: {row.reason}"
            for row in rows
            if row.status is not Status.OK
        ],
        scenes=counted(len(unique(row.scene for row in rows)), "scene"),
    )


def _wrappable(preamble: str) -> str:
    """Return the text as HTML whose lines a page may end anywhere but within an option."""
    joined = escape(re.sub(r"\n +", " ", preamble))
    return re.sub(
        r"(?<=\s)--?[a-z][a-z0-9-]*(?=\s|$)", r'<span class="option">\g<0></span>', joined
    )


def file_table(rows: Sequence[BenchRow]) -> Table:
    """Return a table with a row for each measured file.

    Args:
        rows: From `run_bench` with file sizes.
    """
    measured = [row for row in rows if row.measured and row.format]
    labels = unique(one.label for row in measured for one in row.sets)
    scores = [f"{name} {label}".strip() for label in labels for name in ("PSNR", "SSIM")]
    head = ("scene", "method", "size", "bytes", "splats", "seconds", *scores)
    return Table(head, [_file_cells(row, labels) for row in measured], left=3)


def _file_cells(row: BenchRow, labels: Sequence[str]) -> list[str]:
    cells = [row.scene, row.method, row.target.text, number_text(row.file_bytes, 0)]
    cells += [number_text(row.splats, 0), number_text(row.seconds, 1)]
    for label in labels:
        score = score_on(row, label)
        cells.append(number_text(score.psnr if score else None, 2))
        cells.append(number_text(score.ssim if score else None, 3))
    return cells
