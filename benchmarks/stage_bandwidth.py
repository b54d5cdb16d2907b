"""Compare the seconds of each stage with the time to stream its bytes through memory once.

mkdir -p build
python -m pytest benchmarks/bench_stages.py --benchmark-json build/stages.json
python benchmarks/stage_bandwidth.py build/stages.json
"""

import argparse
import json
from pathlib import Path
from statistics import median


def main() -> None:
    """Print a Markdown table with a row for each stage."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("times", type=Path, help="JSON file of pytest-benchmark")
    entries = json.loads(parser.parse_args().times.read_text())["benchmarks"]
    rows = {
        entry["name"].removeprefix("test_"): (
            entry["extra_info"]["MB"],
            1000 * median(entry["stats"]["data"]),
        )
        for entry in entries
    }
    moved, took = rows["copy"]
    print("| stage | ms | MB moved at least | times the streaming of these |\n|---|--:|--:|--:|")
    for name, (size, milliseconds) in rows.items():
        ratio = milliseconds / (size * took / moved)
        print(f"| {name} | {milliseconds:.1f} | {size:.1f} | {ratio:.1f} |")


if __name__ == "__main__":
    main()
