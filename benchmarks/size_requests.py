"""Test random requests for file sizes on random small models.

    python benchmarks/size_requests.py [--count 1000] [--seed 1] [--only 17,23]
        [--scenes ../shared/scenes]

A request is a model (synthetic, degenerate, or a piece of a real scene), a format, a preset with
few views and steps, a size from below the smallest possible to above the whole model (or, for every
tenth, a PSNR) and some options; in memory, from a file, in blocks or through the command. The file
must not be larger than requested, must have the size and number of splats that the report states,
and must be readable; if it takes less than 98 % of the size, notes must say why. A refusal must be
one sentence and leave no files; the smallest possible size that it names must be possible, and one
byte less must not. `tests/random_requests.py` draws requests and checks results. Request K of a
seed does not depend on the number of requests.
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PRESETS = ("fast", "fast", "default", "default", "default", "best")
SCENES = ("guitar.compressed.ply", "biker.spz", "kitchen.spz", "skull.sog", "plant.splat")


def main() -> None:
    """Run the requests and print tables of their results."""
    options = _options()
    sys.path.insert(0, str(ROOT / "tests"))
    import nanogs
    import random_requests

    paths = [path for name in SCENES if (path := options.scenes / name).exists()]
    scenes = {path.name: nanogs.load(path) for path in paths}
    numbers = [int(each) for each in options.only.split(",")] if options.only else None
    results: list[tuple[random_requests.Request, random_requests.Outcome]] = []
    start = time.perf_counter()
    for number in numbers or range(options.first, options.first + options.count):
        rng = np.random.default_rng([options.seed, number])
        request = random_requests.random_request(rng, scenes, PRESETS)
        outcome = random_requests.run_and_check(request)
        results.append((request, outcome))
        if outcome.faults or numbers:
            text = outcome.faults or outcome.error or f"{outcome.used_fraction}"
            print(f"request {number}: {request}\n    {text}", flush=True)
    print(f"\n{len(results):,} requests in {time.perf_counter() - start:.0f} s\n")
    _tables(results)
    sys.exit(any(outcome.faults for _, outcome in results))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="requests")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seed", type=int, default=1, help="of the random requests")
    parser.add_argument("--only", help="numbers of requests, with commas between")
    parser.add_argument("--scenes", type=Path, default=ROOT.parent / "shared" / "scenes")
    return parser.parse_args()


def _tables(results: list) -> None:  # type: ignore[type-arg]
    import random_requests

    print("| requests | all | met | whole model | refused | wrong | least used | median used |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    rows = {"all": results}
    for name in ("suffix", "preset", "mode"):
        for value in sorted({getattr(request, name) for request, _ in results}):
            rows[value] = [each for each in results if getattr(each[0], name) == value]
    rows["a PSNR"] = [each for each in results if "psnr" in each[0].goal]
    for name, chosen in rows.items():
        found = [outcome for _, outcome in chosen]
        used_fraction = [
            outcome.used_fraction
            for outcome in found
            if outcome.used_fraction and not outcome.whole
        ]
        share = (
            f"{min(used_fraction):.0%} | {np.median(used_fraction):.1%}" if used_fraction else "| "
        )
        counts = [
            sum(not outcome.error for outcome in found), sum(outcome.whole for outcome in found),
            sum(bool(outcome.error) for outcome in found),
            sum(bool(outcome.faults) for outcome in found),
        ]  # fmt: skip
        print(f"| {name} | {len(chosen)} | {' | '.join(map(str, counts))} | {share} |")
    print("\nRefused with:")
    for text, times in Counter(
        random_requests.message_template(outcome.error) for _, outcome in results if outcome.error
    ).most_common():
        print(f"{times:5} {text}")


if __name__ == "__main__":
    main()
