"""Test random requests ("wishes") for file sizes on random small models.

    python benchmarks/wishes.py [--count 1000] [--seed 1] [--only 17,23] [--scenes ../shared/scenes]

A wish is a model (synthetic, degenerate, or a piece of a real scene), a format, a preset with few
views and steps, a size from below the smallest possible to above the whole model (or, for every
tenth, a PSNR) and some options; in memory, from a file, in blocks or through the command. The file
must not be larger than requested, must have the size and number of splats that the report states,
and must be readable; if it takes less than 98 % of the size, notes must say why. A refusal must be
one sentence and leave no files; the smallest possible size that it names must be possible, and one
byte less must not. `tests/wishing.py` draws wishes and checks results. Wish K of a seed does not
depend on the number of wishes.
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
    """Run the wishes and print tables of their results."""
    options = _options()
    sys.path.insert(0, str(ROOT / "tests"))
    import nanogs
    import wishing

    paths = [path for name in SCENES if (path := options.scenes / name).exists()]
    scenes = {path.name: nanogs.load(path) for path in paths}
    numbers = [int(each) for each in options.only.split(",")] if options.only else None
    made: list[tuple[wishing.Wish, wishing.Met]] = []
    start = time.perf_counter()
    for number in numbers or range(options.first, options.first + options.count):
        rng = np.random.default_rng([options.seed, number])
        wish = wishing.draw(rng, scenes, PRESETS)
        met = wishing.fulfil(wish)
        made.append((wish, met))
        if met.wrong or numbers:
            text = met.wrong or met.refused or f"{met.used}"
            print(f"wish {number}: {wish}\n    {text}", flush=True)
    print(f"\n{len(made):,} wishes in {time.perf_counter() - start:.0f} s\n")
    _tables(made)
    sys.exit(any(met.wrong for _, met in made))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="wishes")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn")
    parser.add_argument("--only", help="numbers of wishes, with commas between")
    parser.add_argument("--scenes", type=Path, default=ROOT.parent / "shared" / "scenes")
    return parser.parse_args()


def _tables(made: list) -> None:  # type: ignore[type-arg]
    import wishing

    print("| wishes | all | met | whole model | refused | wrong | least used | median used |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    rows = {"all": made}
    for name in ("suffix", "preset", "way"):
        for value in sorted({getattr(wish, name) for wish, _ in made}):
            rows[value] = [each for each in made if getattr(each[0], name) == value]
    rows["a PSNR"] = [each for each in made if "psnr" in each[0].goal]
    for name, some in rows.items():
        found = [met for _, met in some]
        used = [met.used for met in found if met.used and not met.whole]
        share = f"{min(used):.0%} | {np.median(used):.1%}" if used else "| "
        counts = [
            sum(not met.refused for met in found), sum(met.whole for met in found),
            sum(bool(met.refused) for met in found), sum(bool(met.wrong) for met in found),
        ]  # fmt: skip
        print(f"| {name} | {len(some)} | {' | '.join(map(str, counts))} | {share} |")
    print("\nRefused with:")
    for text, times in Counter(
        wishing.kind(met.refused) for _, met in made if met.refused
    ).most_common():
        print(f"{times:5} {text}")


if __name__ == "__main__":
    main()
