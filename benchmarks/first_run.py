"""Measure how much longer a first run takes, without cached kernels, than a second one.

    python benchmarks/first_run.py [--rounds 5] [--presets fast,default] [--count 3000]

In each round each preset runs the command with an empty `NUMBA_CACHE_DIR`, and then again. Use an
environment like that of users, with compiled byte code, as `pip install .` makes.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import nanogs
from nanogs.datasets.synthetic import make_scene


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--presets", default="fast,default", help="with commas between")
    parser.add_argument("--count", type=int, default=3000)
    options = parser.parse_args()
    presets = options.presets.split(",")
    beyond: dict[str, list[float]] = {preset: [] for preset in presets}
    with TemporaryDirectory() as folder:
        model = Path(folder, "scene.ply")
        nanogs.save(make_scene(options.count), model)
        for turn in range(options.rounds):
            for preset in presets:
                cache = Path(folder, f"{preset}_{turn}")
                first, second = (seconds(model, preset, cache) for _ in range(2))
                beyond[preset].append(first - second)
                print(f"{preset}: {first:.2f}, {second:.2f} s", file=sys.stderr, flush=True)
    print("| | least | median |\n|---|--:|--:|")
    for preset, each in beyond.items():
        print(f"| `{preset}` | {min(each):.1f} | {median(each):.1f} |")


def seconds(model: Path, preset: str, cache: Path) -> float:
    """Return the seconds of one run, with the kernel cache in a given folder."""
    words = ["-m", "nanogs", "simplify", model, model.with_name("out.ply"), "-w", "-q"]
    command = list(map(str, [sys.executable, *words, "--ratio", 0.1, "--preset", preset]))
    start = time.perf_counter()
    subprocess.run(command, env=os.environ | {"NUMBA_CACHE_DIR": str(cache)}, check=True)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
