"""Put random models of extreme values through every function, and report what goes wrong.

    python benchmarks/extremes.py [--seconds 300] [--seed 1]

Values are NaN, infinite, at the limits of single precision or all alike, models have 1 to 300
splats. Every call must succeed or be refused with a `NanogsError`; other errors and warnings are
printed with the number of their case, and make the exit status 1.
"""

import argparse
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

import nanogs
from nanogs.splats import Splats

VALUES = (
    np.nan, np.inf, -np.inf, 3.4e38, 1e38, -1e38, 1e20, 1e-38, 88, -88, 20, -20, 1, -1, 0,
)  # fmt: skip
WRITTEN = (
    ".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".npz", ".glb", ".gltf", ".usda", ".rad",
    ".ksplat", ".html",
)  # fmt: skip
SINGLE = WRITTEN[:10]  # that can be read again
SMALL = {"views": 4, "view_size": 64, "steps": 3, "further": 2}  # for presets that render
Calls = Iterator[tuple[str, Callable[[], object]]]


def main() -> None:
    """Try cases until the time is over, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=300, help="how long to go on")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn")
    options = parser.parse_args()
    warnings.simplefilter("error")
    end, case, calls, found = time.monotonic() + options.seconds, 0, 0, set[str]()
    while time.monotonic() < end:
        case += 1
        random = np.random.default_rng([options.seed, case])
        with tempfile.TemporaryDirectory() as folder:
            for name, call in calls_of(random, Path(folder)):
                calls += 1
                where = failure_of(call)
                if where and where not in found:
                    found.add(where)
                    print(f"case {case}, {name}: {where}", flush=True)
    print(f"{case:,} models, {calls:,} calls, {len(found)} failures")
    sys.exit(bool(found))


def failure_of(call: Callable[[], object]) -> str | None:
    """Make a call; return its error and where it was raised, or None."""
    try:
        call()
    except (nanogs.NanogsError, MemoryError):
        return None
    except Exception as error:  # what is searched for
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if "nanogs" in Path(frame.filename).parts] or frames
        return f"{type(error).__name__}: {error} ({own[-1].filename}:{own[-1].lineno})"
    return None


def calls_of(random: Generator, folder: Path) -> Calls:
    """Yield calls for one random model, each with its name; some use files of earlier ones."""
    splats, preset = random_model(random), str(random.choice(["fast", "default", "best", "paper"]))
    given: dict[str, Any] = SMALL if preset in ("default", "best") else {}
    wish: dict[str, Any] = {"ratio": float(random.choice([1, 0.5, 0.1]))}
    if random.random() < 0.2 and preset != "paper":
        wish = {"psnr": 30.0} if random.random() < 0.5 else {"draw_cost": 0.5}
    yield f"simplify {preset}", lambda: nanogs.simplify(splats, preset=preset, **wish, **given)
    half = splats.take(np.arange(0, len(splats), 2))
    yield "compare", lambda: nanogs.compare(splats, half, views=2, pixels=64)
    few = nanogs.RefitParameters(rounds=1, steps=2, views=4)
    yield "refit", lambda: nanogs.refit(splats, half, parameters=few)
    kind = str(random.choice(["auto", "roam", "inside", "orbit"]))
    yield "render", lambda: nanogs.render(splats, kind, views=2, pixels=48)
    yield "mode_evidence", lambda: nanogs.mode_evidence(splats)
    yield "picture", splats._repr_html_
    packed = str(random.choice([".spz", ".sog", ".splat", ".compressed.ply"]))
    yield f"packing_cost {packed}", lambda: nanogs.packing_cost(splats, packed)
    layout = str(random.choice(["3d tiles", "streamed sog"]))
    yield (
        f"levels {layout}",
        lambda: nanogs.write_levels(
            splats, folder / "levels", [1, 0.5, 0.1], layout=layout, preset="fast", chunk=20
        ),
    )
    written = folder / f"a{random.choice(WRITTEN)}"
    yield f"save {written.suffix}", lambda: nanogs.save(splats, written)
    if not written.exists() or written.suffix == ".html":
        return
    yield f"info {written.suffix}", lambda: nanogs.info(written)
    other, small = (folder / f"{name}{random.choice(SINGLE)}" for name in "bc")
    yield f"convert {written.suffix} {other.suffix}", lambda: nanogs.convert(written, other)
    if preset == "paper":
        return
    goal: dict[str, Any] = {"ratio": 0.5}
    if random.random() < 0.5:
        goal = {"size": int(random.choice([500, 3000, 20_000]))}
    block = int(random.choice([60, 1_000_000]))
    yield (
        f"simplify_blocks {preset} {small.suffix}",
        lambda: nanogs.simplify_blocks(
            written, small, preset=preset, block=block, threads=1, **goal, **given
        ),
    )


def random_model(random: Generator) -> Splats:
    """Make a model of which some values are extreme."""
    count, degree = int(random.choice([1, 2, 3, 5, 17, 60, 300])), int(random.integers(4))

    def normal(*width: int) -> Any:  # noqa: ANN401 - an array of float32
        return random.normal(size=(count, *width)).astype(np.float32)

    columns = {
        "means": normal(3) * np.float32(random.choice([1e-6, 1, 1e3, 1e8])),
        "log_scales": normal(3) - np.float32(random.choice([0, 3, 9, 30])),
        "quats": normal(4),
        "opacity_logits": 3 * normal(),
        "sh": normal((degree + 1) ** 2, 3) / 2,
    }
    for _ in range(random.integers(5)):
        column = columns[str(random.choice(list(columns)))]
        column[random.random(column.shape) < random.choice([0.02, 0.3, 1])] = random.choice(VALUES)
    if random.random() < 0.3:
        for column in columns.values():
            column[:] = column[0]
    return Splats(**columns)


if __name__ == "__main__":
    main()
