"""Measure the speed-up by more threads, stage by stage, of whole runs from file to file.

    python benchmarks/cores.py [MODEL] [--count 1000000] [--rounds 5] [--ratio 0.1] [--presets fast]
                               [--threads 1,2] [--no-query] [--output out.ply] [--separate]

MODEL is a 3DGS file; without one, a scene of --count splats of SH degree 3 is generated. Each round
runs each preset once with each number of threads, so that other load of the machine disturbs all.
Rows are medians: the stages of the report, `rest` for the rest of the call, `start` for the rest of
the process, and `file to file` for the whole process. The last columns compare one thread with the
most, n: how many times as fast these are, and the serial share s by Amdahl's law,
tn / t1 = s + (1 - s) / n, which is above 1 if more threads make a stage slower. After the table: a
query of all centres by scipy's cKDTree with two workers, as in `benchmarks/speed.py`, measured in
the same rounds. With --separate each round also runs two processes at once, of one thread each,
which share nothing but the machine: the work that they do in the time of one is the most that a
second thread can gain there.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from speed import WORK, query, scene, simplify_command

WHOLE = "file to file"
Seconds = dict[str, float]


def main() -> None:
    """Print a table for each preset."""
    options = arguments()
    WORK.mkdir(parents=True, exist_ok=True)
    model = options.model or scene(options.count)
    presets = options.presets.split(",")
    counts = [int(count) for count in options.threads.split(",")]
    if counts[0] != 1 or len(counts) < 2:
        raise SystemExit("--threads needs 1 and more, such as 1,2.")
    for preset in presets:  # compile what is not in the cache, on a small scene
        run(scene(2000), preset, max(counts), options)
    seconds_of_runs: dict[tuple[str, int], list[Seconds]] = {}
    separate_times: dict[str, list[float]] = {preset: [] for preset in presets}
    ask, query_times = None if options.no_query else query(model), []
    for _ in range(options.rounds):
        for preset in presets:
            for threads in counts:
                seconds = run(model, preset, threads, options)
                seconds_of_runs.setdefault((preset, threads), []).append(seconds)
                text = f"{preset}, {threads} threads: {seconds[WHOLE]:.2f} s"
                print(text, file=sys.stderr, flush=True)
            if options.separate:
                separate_times[preset].append(run_separately(model, preset, options))
        if ask:
            query_times.append(ask()[0])
    for preset in presets:
        medians = {threads: middle(seconds_of_runs[preset, threads]) for threads in counts}
        show(preset, medians)
        if query_times:
            query_seconds = median(query_times)
            print(f"\nOne cKDTree query: {query_seconds:.2f} s.", end=" ")
            overs = ", ".join(f"{medians[n][WHOLE] / query_seconds:.2f}" for n in counts)
            print(f"{options.threads} threads take {overs} times that.")
        if options.separate:
            separate = median(separate_times[preset])
            gain = 2 * medians[1][WHOLE] / separate
            print(f"\nTwo processes at once: {separate:.2f} s, {gain:.2f} times the work of one.")


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--ratio", type=float, default=0.1)
    parser.add_argument("--presets", default="fast", help="with commas between")
    parser.add_argument("--threads", default="1,2", help="ascending from 1, with commas between")
    parser.add_argument("--no-query", action="store_true", help="without the k-d tree")
    parser.add_argument("--output", default="cores.ply", help="name of the file that is written")
    parser.add_argument("--separate", action="store_true", help="also run two processes at once")
    return parser.parse_args()


def run(model: Path, preset: str, threads: int, options: argparse.Namespace) -> Seconds:
    """Run the command once; return its seconds by stage, and those outside the stages."""
    command = simplify_command(model, WORK / options.output, preset, options.ratio, threads)
    start = time.perf_counter()
    result = subprocess.run([*command, "--json"], check=True, stdout=subprocess.PIPE, text=True)
    whole = time.perf_counter() - start
    report = json.loads(result.stdout)
    call, stages = report["total_seconds"], report["seconds"]
    return {**stages, "rest": call - sum(stages.values()), "start": whole - call, WHOLE: whole}


def run_separately(model: Path, preset: str, options: argparse.Namespace) -> float:
    """Return the seconds until two runs of one thread each, started together, have ended."""
    outputs = [WORK / f"{number}_{options.output}" for number in (1, 2)]
    start = time.perf_counter()
    processes = [
        subprocess.Popen(simplify_command(model, output, preset, options.ratio, 1))
        for output in outputs
    ]
    codes = [process.wait() for process in processes]
    seconds = time.perf_counter() - start
    if any(codes):
        raise SystemExit(f"a run of {preset} ended with exit code {max(codes)}")
    return seconds


def middle(runs: list[Seconds]) -> Seconds:
    """Return the median of each row."""
    return {name: median(each[name] for each in runs) for name in runs[0]}


def show(preset: str, medians: dict[int, Seconds]) -> None:
    """Print a preset's rows as Markdown; medians: of each number of threads, ascending from 1."""
    one, most = medians[1], max(medians)
    columns = " | ".join(f"{n} thread{'s' if n > 1 else ''}, s" for n in medians)
    print(f"\n| {preset} | {columns} | times as fast | serial share |")
    print("|---|" + "--:|" * (len(medians) + 2))
    for name, alone in one.items():
        seconds = [each[name] for each in medians.values()]
        share = seconds[-1] / alone if alone else 1.0
        cells = " | ".join(f"{each:.3f}" for each in seconds)
        serial = (share - 1 / most) / (1 - 1 / most)
        print(f"| {name} | {cells} | {1 / share if share else 1:.2f} | {serial:.2f} |")


if __name__ == "__main__":
    main()
