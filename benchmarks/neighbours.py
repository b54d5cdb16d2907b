"""Time our nearest-neighbour search against scipy's k-d tree, on real scenes and uniform points.

    python benchmarks/neighbours.py [SCENES] [--only biker,uniform] [--repeats 7] [--threads 2]

SCENES, or the environment variable NANOGS_SCENES, is the folder of the scenes; by default
../shared/scenes beside the repository. Both build their tree and query it with all points, which
are in Morton order; they alternate, so that other load of the machine disturbs both. The table on
stdout gives the median seconds of each, and the median of the ratios of successive runs.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import nanogs
from nanogs._types import F64, I32
from nanogs.method.order import morton_order
from nanogs.neighbours import nearest_neighbours
from nanogs.threads import use_threads
from rivals import REAL_SCENES

SCENES = {
    "biker": "biker.compressed.ply",
    "guitar": "guitar.compressed.ply",
    "plant": "plant.splat",
    "seal": "seal.splat",
    "chair": "chair.splat",
}
UNIFORM = 1_000_000  # points in the unit cube
FLYAWAYS = 0.001  # share of the points that are placed about a million extents away


def main() -> None:
    """Print one row for each set of points and k."""
    options = arguments()
    only = options.only.split(",") if options.only else [*SCENES, "uniform", "flyaways"]
    print("| points | number | k | cKDTree (s) | nanogs (s) | ratio |")
    print("|---|--:|--:|--:|--:|--:|")
    for name, means in point_sets(options.scenes, only):
        ordered = means[morton_order(means)]
        for k in (8, 16):
            with use_threads(options.threads) as threads:
                theirs, ours, ratio = compare(ordered, k, threads, options.repeats)
            print(
                f"| {name} | {len(means):,} | {k} | {theirs:.3f} | {ours:.3f} | {ratio:.2f} |",
                flush=True,
            )


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=REAL_SCENES)
    parser.add_argument("--only", help="names of scenes, uniform, flyaways, with commas between")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    return parser.parse_args()


def point_sets(folder: Path, names: list[str]) -> Iterator[tuple[str, F64]]:
    """Yield the centres of each scene that exists, and random points."""
    for name in names:
        if name in SCENES:
            if not (folder / SCENES[name]).exists():
                print(f"{name}: no {folder / SCENES[name]}", file=sys.stderr)
                continue
            means = nanogs.load(folder / SCENES[name]).means.astype(np.float64)
            yield name, means[np.isfinite(means).all(axis=1)]
        else:
            rng = np.random.default_rng(0)
            means = rng.uniform(size=(UNIFORM, 3))
            if name == "flyaways":
                far = int(FLYAWAYS * UNIFORM)
                means[:far] = rng.normal(size=(far, 3)) * 1e6
            yield name, means


def compare(means: F64, k: int, threads: int, repeats: int) -> tuple[float, float, float]:
    """Return the median seconds of the k-d tree and of ours, and the median of their ratios.

    `threads` is the number in use, which only the k-d tree has to be told.
    """

    def theirs() -> I32:
        found: I32 = cKDTree(means, leafsize=16).query(means, k + 1, workers=threads)[1]
        return found

    def ours() -> I32:
        return nearest_neighbours(means, k)

    nearest_neighbours(means[:100], k)  # compiles
    turns = np.array([(seconds(theirs), seconds(ours)) for _ in range(repeats)])
    ratio = np.median(turns[:, 0] / turns[:, 1])
    return (*np.median(turns, axis=0).tolist(), float(ratio))


def seconds(work: Callable[[], I32]) -> float:
    """Measure the wall-clock seconds of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
