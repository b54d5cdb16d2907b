"""Print how far our presets are ahead of the better of the other tool's two modes.

    python benchmarks/leads.py build/quality/results/results.jsonl

Reads the rows that benchmarks/quality.py wrote. For PSNR and SSIM the better mode is found for each
alone, so it may be another one.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from statistics import mean
from typing import Any

OTHERS = ("st-uniform", "st-adaptive")
OURS = ("default", "fast", "best", "paper")

Key = tuple[str, float]
Leads = list[tuple[float, float]]


def main() -> None:
    """Group the rows by scene and ratio, and print the leads."""
    rows = [json.loads(line) for line in Path(sys.argv[1]).read_text().splitlines()]
    rows = [row for row in rows if row["status"] == "ok" and row["psnr"] is not None]
    groups: dict[Key, dict[str, Any]] = defaultdict(dict)
    for row in rows:
        groups[row["scene"], row["ratio"]][row["method"]] = row
    groups = {key: group for key, group in groups.items() if set(OTHERS) <= set(group)}
    present = [name for name in OURS if any(name in group for group in groups.values())]
    print("| scene | ratio | better of the others | " + " | ".join(present) + " |")
    print("|---|--:|--:|" + "--:|" * len(present))
    leads: dict[float, dict[str, Leads]] = defaultdict(lambda: defaultdict(list))
    for (scene, ratio), group in sorted(groups.items(), key=lambda item: (-item[0][1], item[0][0])):
        psnr, ssim = (max(group[name][value] for name in OTHERS) for value in ("psnr", "ssim"))
        cells = []
        for name in present:
            lead = (group[name]["psnr"] - psnr, group[name]["ssim"] - ssim)
            cells.append(f"{lead[0]:+.2f} / {lead[1]:+.3f}")
            if not scene.endswith("-photographs"):
                leads[ratio][name].append(lead)
        print(f"| {scene} | {ratio:g} | {psnr:.2f} / {ssim:.3f} | " + " | ".join(cells) + " |")
    for ratio, by_name in leads.items():
        cells = [_summary(by_name[name]) for name in present]
        print(f"| **mean (least)** | {ratio:g} | | " + " | ".join(cells) + " |")


def _summary(leads: Leads) -> str:
    psnr, ssim = zip(*leads, strict=True)
    return f"{mean(psnr):+.2f} ({min(psnr):+.2f}) / {mean(ssim):+.3f} ({min(ssim):+.3f})"


if __name__ == "__main__":
    main()
