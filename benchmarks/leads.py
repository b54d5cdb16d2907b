"""Print the lead of our presets over the better of splat-transform's two modes.

    python benchmarks/leads.py ROWS [--scenes plant,biker]

Reads rows that benchmarks/quality.py wrote with --rows. The better mode is chosen for each number
separately. Means leave photographs out.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from rivals import RIVALS

OURS = ("fast", "default", "best", "paper")
TITLES = {"roam": "roaming", "inside": "from inside", "photographs": "photographs"}
Row = dict[str, Any]
Group = dict[str, Row]  # the rows of one scene, ratio and kind, by method


def main() -> None:
    """Print the tables of a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", type=Path)
    parser.add_argument("--scenes", help="names, with commas between")
    options = parser.parse_args()
    rows = [json.loads(line) for line in options.rows.read_text().splitlines()]
    names = options.scenes.split(",") if options.scenes else None
    print(report([row for row in rows if names is None or row["scene"] in names]))


def report(rows: Sequence[Row]) -> str:
    """Return all tables as Markdown."""
    groups: dict[tuple[str, float, str], Group] = defaultdict(dict)
    for row in rows:
        groups[row["scene"], row["ratio"], row["kind"]][row["method"]] = row
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    parts = [means_table(rows, kinds)]
    compared = {key: group for key, group in groups.items() if set(RIVALS) <= set(group)}
    if any(set(OURS) & set(group) for group in compared.values()):
        for value, heading in (("ssim", "SSIM"), ("psnr", "dB of PSNR")):
            table = summary_table(compared, kinds, value)
            parts.insert(0, f"Leads in {heading}, mean (least) of the scenes:\n\n{table}")
        parts.insert(2, scenes_table(compared))
        parts.insert(3, order_text(groups))
    return "\n".join(parts)


def title(kind: str) -> str:
    """Format a kind of views as a heading."""
    source, _, size = kind.partition("@")
    if source.isdigit():
        return f"{source}, automatic"
    return TITLES.get(source, source) + (f", {size}" if size else "")


def lead(group: Group, method: str, value: str) -> float:
    """Return the difference of a method to the better mode in one number."""
    found: float = group[method][value] - max(group[name][value] for name in RIVALS)
    return found


def summary_table(
    groups: dict[tuple[str, float, str], Group], kinds: Sequence[str], value: str
) -> str:
    """Return the mean and least lead of each preset at each ratio, a column for each kind."""
    shown = [kind for kind in kinds if kind != "photographs"]
    lines = ["| | " + " | ".join(map(title, shown)) + " |", "|---|" + "--:|" * len(shown)]
    digits = 2 if value == "psnr" else 3
    for ratio in dict.fromkeys(ratio for _, ratio, _ in groups):
        for method in OURS:
            cells = []
            for kind in shown:
                leads = [
                    lead(group, method, value)
                    for (_, at_ratio, of), group in groups.items()
                    if (at_ratio, of) == (ratio, kind) and method in group
                ]
                cells.append(
                    f"{mean(leads):+.{digits}f} ({min(leads):+.{digits}f})" if leads else ""
                )
            if any(cells):
                lines.append(f"| `{method}` {ratio:g} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def scenes_table(groups: dict[tuple[str, float, str], Group]) -> str:
    """Return the table of scenes: the better mode's PSNR and SSIM, and the leads."""
    present = [name for name in OURS if any(name in group for group in groups.values())]
    lines = [
        "| scene | ratio | views | better of the others | " + " | ".join(present) + " |",
        "|---|--:|---|--:|" + "--:|" * len(present),
    ]
    for (scene, ratio, kind), group in sorted(groups.items(), key=lambda item: -item[0][1]):
        best = " / ".join(
            f"{max(group[name][value] for name in RIVALS):.{digits}f}"
            for value, digits in (("psnr", 2), ("ssim", 3))
        )
        cells = [
            f"{lead(group, name, 'psnr'):+.2f} / {lead(group, name, 'ssim'):+.3f}"
            if name in group
            else ""
            for name in present
        ]
        lines.append(f"| {scene} | {ratio:g} | {title(kind)} | {best} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def order_text(groups: dict[tuple[str, float, str], Group]) -> str:
    """List the cases in which a slower preset has no higher PSNR than a faster one."""
    lines = [
        f"- {scene} at {ratio:g}, {title(kind)}: {upper} {group[upper]['psnr']:.2f} dB,"
        f" {lower} {group[lower]['psnr']:.2f} dB"
        for (scene, ratio, kind), group in groups.items()
        for lower, upper in (("fast", "default"), ("default", "best"))
        if {lower, upper} <= set(group) and group[upper]["psnr"] <= group[lower]["psnr"]
    ]
    return (
        "".join(f"{line}\n" for line in ["Not above the faster preset:", "", *lines])
        if lines
        else ""
    )


def means_table(rows: Sequence[Row], kinds: Sequence[str]) -> str:
    """Return PSNR and SSIM of each method, means over the scenes that all methods have."""
    shown = [kind for kind in kinds if kind != "photographs"]
    lines = ["| method | ratio | " + " | ".join(map(title, shown)) + " |"]
    lines += ["|---|--:|" + "--:|" * len(shown)]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for ratio in dict.fromkeys(row["ratio"] for row in rows):
        at_ratio = [row for row in rows if row["ratio"] == ratio]
        common = {row["scene"] for row in at_ratio}
        for method in methods:
            common &= {row["scene"] for row in at_ratio if row["method"] == method}
        for method in methods:
            of = [row for row in at_ratio if row["method"] == method and row["scene"] in common]
            cells = [_mean_cell([row for row in of if row["kind"] == kind]) for kind in shown]
            if any(cells):
                lines.append(f"| {method} | {ratio:g} | {' | '.join(cells)} |")
    return "Means of PSNR (dB) / SSIM:\n\n" + "\n".join(lines) + "\n"


def _mean_cell(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    return f"{mean(row['psnr'] for row in rows):.2f} / {mean(row['ssim'] for row in rows):.3f}"


if __name__ == "__main__":
    main()
