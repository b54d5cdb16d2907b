"""Rows as Markdown and as JSON lines."""

import json
import math
from collections.abc import Callable, Sequence

from nanogs.bench.gains import MeanGain, mean_gains
from nanogs.bench.means import TargetMean, mean_rows, unique
from nanogs.bench.methods import ABLATED
from nanogs.bench.published_table import published_tables
from nanogs.bench.rows import BenchRow, SetScore, Status
from nanogs.bench.size_tables import ALONE, LEGEND, TITLE, gain_remarks, gain_table
from nanogs.formatting import NONE, counted, number_text

Column = tuple[str, Callable[[BenchRow], str]]


def markdown(rows: Sequence[BenchRow], *, others: Sequence[str] = ()) -> str:
    """Return all tables as Markdown: published protocol, means, ablations, then each scene.

    With file sizes, gains at equal size come before the means.

    Args:
        rows: From `run_bench`.
        others: Anchors of the gains; see `gains.mean_gains`.
    """
    parts = [f"# {title}\n\n{text}" for title, text in published_tables(rows)]
    if any(row.size is not None for row in rows):
        parts.append(f"# {TITLE}\n\n{gains_text(mean_gains(rows, others))}")
    for against in unique(row.against for row in rows):
        group = [row for row in rows if row.against == against]
        means = mean_rows(group)
        if means:
            title = f"Means over scenes, against {against}"
            parts.append(f"# {title}\n\n{mean_table(means)}")
        ablations = ablation_table(means)
        if ablations:
            title = f"Ablations of {ABLATED}, against {against}"
            parts.append(f"# {title}\n\n{ablations}")
    for scene in unique(row.scene for row in rows):
        group = [row for row in rows if row.scene == scene]
        parts.append(f"# {_escape(scene)}\n\n{scene_table(group)}")
    return "\n".join(parts)


def gains_text(gains: Sequence[MeanGain]) -> str:
    """Return the table of gains, its legend, and a list of scenes without a figure.

    Args:
        gains: From `mean_gains`.
    """
    if not gains:
        return f"{ALONE}\n"
    table = gain_table(gains)
    rule = ["---" if column < table.left else "--:" for column in range(len(table.head))]
    lines = [table.head, rule, *([_escape(cell) for cell in row] for row in table.rows)]
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    remarks = "".join(f"- {_escape(remark)}\n" for remark in gain_remarks(gains))
    return f"{text}\n{LEGEND}\n" + (f"\n{remarks}" if remarks else "")


def json_line(row: BenchRow) -> str:
    """Return a row as one line of JSON; infinities are strings."""
    return json.dumps(row.to_dict(), allow_nan=False) + "\n"


def scene_table(rows: Sequence[BenchRow]) -> str:
    """Return one scene's rows as a table, followed by reasons of failure and notes.

    Args:
        rows: Rows of one scene.
    """
    intro = f"Against {rows[0].against}, {_views_text(rows)}.\n\n"
    remarks = [(row, text) for row in rows for text in _remarks(row)]
    listed = "".join(
        f"- {_escape(row.method)} at {row.target.text}: {_escape(text)}\n" for row, text in remarks
    )
    return intro + _table(rows) + (f"\n{listed}" if listed else "")


def _views_text(rows: Sequence[BenchRow]) -> str:
    """Return the number of views, for each set if there are several."""
    widest = max(rows, key=lambda row: (len(row.further), row.views or 0))
    texts = [counted(one.views or 0, "view") for one in widest.sets]
    if widest.further:
        texts = [f"{text} ({one.label})" for text, one in zip(texts, widest.sets, strict=True)]
    return ", ".join(texts)


def _remarks(row: BenchRow) -> list[str]:
    failed = [] if row.status is Status.OK else [f"{row.status}: {row.reason}"]
    return [*failed, *row.notes]


def mean_table(means: Sequence[TargetMean]) -> str:
    """Return the means of all requests, and the scenes and methods that are left out of them."""
    rows = [row for mean in means for row in mean.methods.values()]
    text = _table(rows) + "\n" if rows else ""
    return text + "".join(_coverage(mean) for mean in means)


def _coverage(mean: TargetMean) -> str:
    scenes = counted(len(mean.scenes), "scene")
    lines = [
        f"- At {mean.target.text}: mean of {scenes} ({_names(mean.scenes)})."
        if mean.scenes
        else f"- At {mean.target.text}: no scene has results of all methods, so there is no mean."
    ]
    for scene, methods in mean.left_out.items():
        why = f"without a result of {_names(methods)}" if methods else "without any result"
        lines.append(f"- At {mean.target.text}, left out: {_escape(scene)}, {why}.")
    if mean.absent:
        lines.append(
            f"- At {mean.target.text}, not compared, without any result: {_names(mean.absent)}."
        )
    return "\n".join(lines) + "\n"


def ablation_table(means: Sequence[TargetMean]) -> str:
    """Return the differences of changed presets to the unchanged one; "" if none was measured.

    Args:
        means: From `mean_rows`.
    """
    lines = []
    for mean in means:
        whole = mean.methods.get(ABLATED)
        for name, row in mean.methods.items():
            if whole is None or not name.startswith(f"{ABLATED}:"):
                continue
            gains = (
                f"{_difference(row.psnr, whole.psnr, 2)} | {_difference(row.ssim, whole.ssim, 3)}"
            )
            values = f"{number_text(row.psnr, 2)} | {number_text(row.ssim, 3)}"
            lines.append(f"| {mean.target.text} | {_escape(name)} | {values} | {gains} |\n")
    if not lines:
        return ""
    head = f"| ratio | variant | PSNR | SSIM | PSNR − {ABLATED} | SSIM − {ABLATED} |\n"  # noqa: RUF001
    return head + "|--:|---|--:|--:|--:|--:|\n" + "".join(lines)


def _difference(value: float | None, base: float | None, digits: int) -> str:
    if value is None or base is None or not math.isfinite(value - base):
        return NONE
    return f"{value - base:+.{digits}f}"


def _table(rows: Sequence[BenchRow]) -> str:
    columns = _columns(rows)
    asked = "size" if any(row.format for row in rows) else "ratio"
    head = f"| method | {asked} | " + " | ".join(name for name, _ in columns) + " |\n"
    rule = "|---|--:|" + "--:|" * len(columns) + "\n"
    body = (
        f"| {_escape(row.method)} | {row.target.text} | "
        + " | ".join(_cells(row, columns))
        + " |\n"
        for row in rows
    )
    return head + rule + "".join(body)


def _cells(row: BenchRow, columns: Sequence[Column]) -> list[str]:
    if row.status is Status.OK:
        return [value(row) for _, value in columns]
    return [str(row.status), *[NONE] * (len(columns) - 1)]


def _columns(rows: Sequence[BenchRow]) -> list[Column]:
    columns: list[Column] = [
        ("splats", lambda row: number_text(row.splats, 0)),
        ("bytes", lambda row: number_text(row.file_bytes, 0)),
        ("seconds", lambda row: number_text(row.seconds, 2)),
        ("peak MB", lambda row: _megabytes(row.peak_memory)),
    ]
    labels = unique(one.label for row in rows for one in row.sets if one.psnr is not None)
    for label in labels or [""]:
        columns += _score_columns(rows, label, several=len(labels) > 1)
    columns.append(("frames/s", lambda row: number_text(row.fps, 1)))
    if any(row.fps_gsplat is not None for row in rows):
        columns.append(("gsplat frames/s", lambda row: number_text(row.fps_gsplat, 0)))
    return columns


def _score_columns(rows: Sequence[BenchRow], label: str, *, several: bool) -> list[Column]:
    """Return the columns of one set of views; if there are several, headings name the set."""
    behind = f", {label}" if several else ""

    def column(name: str, value: Callable[[SetScore], float | None], digits: int) -> Column:
        return name + behind, lambda row: number_text(_on(row, label, value), digits)

    scores = [one for row in rows for one in row.sets if one.label == label]
    return [
        column("PSNR", lambda one: one.psnr, 2),
        column("worst", lambda one: one.least_psnr, 2),
        column("SSIM", lambda one: one.ssim, 3),
        *(
            column(name.upper(), lambda one, name=name: one.extras.get(name), 3)  # type: ignore[misc]
            for name in unique(name for one in scores for name in one.extras)
        ),
    ]


def _on(row: BenchRow, label: str, value: Callable[[SetScore], float | None]) -> float | None:
    """Return a row's value on the set of a label; None if it has none."""
    return next((value(one) for one in row.sets if one.label == label), None)


def _megabytes(count: int | None) -> str:
    return number_text(None if count is None else count * 1e-6, 0)


def _names(names: Sequence[str]) -> str:
    return ", ".join(_escape(name) for name in names)


def _escape(text: str) -> str:
    """Join the text to one line, and escape Markdown's column separators and tags."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
