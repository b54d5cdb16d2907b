"""Measure error and time of palettes (codebooks) of higher spherical harmonics.

    python benchmarks/palettes.py [SCENES] [--only skull,flowers:0.1] [--sets 1.5,3,8,32]
        [--repeats 3]

For each scene, or its simplification by `fast`, a palette of the splats' higher SH coefficients is
computed, with one entry per --sets splats, 65,536 at most. The error is the mean squared error,
weighted by the visibility of each splat; compare it with that of another version, run there.
Seconds are the minimum of the repeats.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import nanogs
from measurements import SCENES
from nanogs.io.palette import palette
from nanogs.io.precision import visibility
from nanogs.io.sog.meta import PALETTE_MAX
from rivals import REAL_SCENES


def main() -> None:
    """Print a row for each scene and size of the palette."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=REAL_SCENES)
    parser.add_argument("--only", default="skull,flowers:0.1,flowers")
    parser.add_argument("--sets", default="1.5,3,8,32", help="sets of harmonics for an entry")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    print("| scene | sets of harmonics | entries | weighted error | seconds |\n" + "|---" * 5 + "|")
    for scene_name in options.only.split(","):
        name, _, ratio = scene_name.partition(":")
        model = nanogs.load(options.scenes / SCENES[name])
        if ratio:
            model, _ = nanogs.simplify(model, ratio=float(ratio), preset="fast")
        points, weights = model.sh[:, 1:].reshape(len(model), -1), visibility(model)
        sizes = [int(len(model) / float(sets)) for sets in options.sets.split(",")]
        for size in dict.fromkeys(min(size, PALETTE_MAX) for size in sizes):
            seconds = []
            for _ in range(options.repeats):
                start = time.perf_counter()
                found = palette(points, size, weights)
                seconds.append(time.perf_counter() - start)
            squares = np.square(points - found.entries[found.labels]).sum(axis=1, dtype=np.float64)
            error, least = float(np.average(squares, weights=weights)), min(seconds)
            count = len(found.entries)
            print(
                f"| {scene_name} | {len(model):,} | {count:,} | {error:.3g} | {least:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
