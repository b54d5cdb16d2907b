"""Time whole runs from file to file: our presets, splat-transform and one k-d tree query.

    python benchmarks/speed.py [MODEL] [--count 1000000] [--rounds 3] [--ratio 0.1] [--alone]
                               [--presets fast,default,paper]
    python benchmarks/speed.py --scaling 100000,200000,500000,1000000,2000000,5000000 [--preset P]
    python benchmarks/speed.py --threads 1,2

MODEL is a 3DGS file; without one, a scene of --count splats of SH degree 3 is generated. Each round
runs each program once, so that other load of the machine disturbs all; the tables on stdout give
medians, and ratios of the medians. All runs are whole processes with compiled kernels. The query is
by scipy's cKDTree, for the 16 nearest neighbours of each centre, with all threads, in Morton order;
its seconds do not include building the tree.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
from scipy.spatial import cKDTree

import nanogs
from nanogs.datasets.synthetic import make_scene
from nanogs.formatting import bytes_text
from nanogs.io import inspect
from nanogs.io.files import splat_bytes
from nanogs.method.order import morton_order
from nanogs.pipeline.options.target import target_count
from rivals import ROOT, install, run_tool, timed

WORK = ROOT / "build" / "speed"
MODES = {"splat-transform uniform": "--decimate", "splat-transform adaptive": "--decimate-adaptive"}
K = 16
Run = Callable[[], tuple[float, int]]


def main() -> None:
    """Print the requested table."""
    options = arguments()
    WORK.mkdir(parents=True, exist_ok=True)
    if options.scaling:
        scaling([int(text) for text in options.scaling.split(",")], options)
        return
    model = options.model or scene(options.count)
    if options.threads:
        threads([int(text) for text in options.threads.split(",")], model, options)
        return
    against_others(model, options)


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--ratio", type=float, default=0.1)
    parser.add_argument("--alone", action="store_true", help="without the other tool")
    parser.add_argument("--scaling", help="counts, with commas between")
    parser.add_argument("--presets", default="fast,default,paper", help="with commas between")
    parser.add_argument("--preset", default="fast", help="with --scaling")
    parser.add_argument("--threads", help="numbers of threads, with commas between")
    return parser.parse_args()


def scene(count: int) -> Path:
    """Return a synthetic scene of `count` splats, generated if it does not exist yet."""
    path = WORK / f"scene_{count}.ply"
    if not path.exists():
        nanogs.save(make_scene(count), path)
    return path


def ours(model: Path, preset: str, options: argparse.Namespace, threads: int | None = None) -> Run:
    """Return a function that runs `nanogs simplify` once."""
    command = simplify_command(model, WORK / "out.ply", preset, options.ratio, threads)
    return lambda: timed(command, {})


def simplify_command(
    model: Path, output: Path, preset: str, ratio: float, threads: int | None = None
) -> list[str | Path]:
    """Return the command line of a run that does not measure its result, because others do not."""
    command: list[str | Path] = [sys.executable, "-m", "nanogs", "simplify", model, output]
    command += ["-w", "-q", "--no-measure", "--preset", preset, "--ratio", str(ratio)]
    return command + ([] if threads is None else ["--threads", str(threads)])


def other(model: Path, flag: str, ratio: float) -> Run:
    """Return a function that runs splat-transform once."""
    count = str(target_count(inspect(model).splats, ratio, None))
    return lambda: run_tool(model, flag, count, WORK / "other.ply")


def query(model: Path) -> Run:
    """Build the k-d tree of a model's centres; return a function that queries it once."""
    means = nanogs.load(model).means.astype(np.float64)
    means = means[morton_order(means)]
    tree = cKDTree(means, leafsize=16)

    def run() -> tuple[float, int]:
        start = time.perf_counter()
        tree.query(means, K + 1, workers=os.cpu_count() or 1)
        return time.perf_counter() - start, 0

    return run


def in_turns(runs: dict[str, Run], rounds: int) -> dict[str, list[tuple[float, int]]]:
    """Run all functions once per round; return their seconds and peak memory."""
    runs_of: dict[str, list[tuple[float, int]]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            runs_of[name].append(run())
            print(f"{name}: {runs_of[name][-1][0]:.2f} s", file=sys.stderr, flush=True)
    return runs_of


def against_others(model: Path, options: argparse.Namespace) -> None:
    """Print time and memory of each preset, splat-transform's modes and the query."""
    presets = options.presets.split(",")
    runs = {preset: ours(model, preset, options) for preset in presets}
    if not options.alone:
        install()
        runs |= {name: other(model, flag, options.ratio) for name, flag in MODES.items()}
    runs[f"cKDTree query, k = {K}"] = query(model)
    warm(options)
    runs_of = in_turns(runs, options.rounds)
    first = median(seconds for seconds, _ in runs_of[presets[0]])
    columns = inspect(model)
    model_size = column_bytes(model)
    print(
        f"{columns.splats:,} splats, SH degree {columns.sh_degree}, "
        f"{bytes_text(model_size)} of columns\n"
    )
    print(f"| | seconds | over {presets[0]} | peak memory | over the columns |")
    print("|---|--:|--:|--:|--:|")
    for name, turns in runs_of.items():
        seconds, peak = (median(values) for values in zip(*turns, strict=True))
        memory = f"{bytes_text(int(peak))} | {peak / model_size:.2f}" if peak else "|"
        print(f"| {name} | {seconds:.2f} | {seconds / first:.2f} | {memory} |")


def warm(options: argparse.Namespace) -> None:
    """Compile kernels that are not cached, by runs on a small scene."""
    for preset in options.presets.split(","):
        ours(scene(2000), preset, options)()


def scaling(counts: list[int], options: argparse.Namespace) -> None:
    """Print time and memory of a preset by count, and the slope of log time over log count."""
    warm(options)
    runs = {f"{count:,}": ours(scene(count), options.preset, options) for count in counts}
    runs_of = in_turns(runs, options.rounds)
    middle = [median(seconds for seconds, _ in turns) for turns in runs_of.values()]
    print("| splats | seconds | microseconds a splat | peak memory | over the columns |")
    print("|--:|--:|--:|--:|--:|")
    for count, seconds, turns in zip(counts, middle, runs_of.values(), strict=True):
        peak = int(median(peak for _, peak in turns))
        memory = f"{bytes_text(peak)} | {peak / column_bytes(scene(count)):.2f}"
        print(f"| {count:,} | {seconds:.2f} | {1e6 * seconds / count:.2f} | {memory} |")
    if len(counts) > 1:
        slope = np.polyfit(np.log(counts), np.log(middle), 1)[0]
        print(f"\nSlope on log-log: {slope:.2f}")


def column_bytes(model: Path) -> int:
    """Return the bytes of a model's float32 columns."""
    columns = inspect(model)
    return columns.splats * splat_bytes(columns.sh_degree)


def threads(numbers: list[int], model: Path, options: argparse.Namespace) -> None:
    """Print the seconds of each preset by number of threads."""
    warm(options)
    runs = {
        f"{preset} | {number}": ours(model, preset, options, number)
        for preset in options.presets.split(",")
        for number in numbers
    }
    runs_of = in_turns(runs, options.rounds)
    print("| preset | threads | seconds |\n|---|--:|--:|")
    for name, turns in runs_of.items():
        print(f"| {name} | {median(seconds for seconds, _ in turns):.2f} |")


if __name__ == "__main__":
    main()
