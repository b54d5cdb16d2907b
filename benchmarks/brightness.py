"""Measure the change of mean brightness of views, on nine real scenes converted by `quality.py`.

    python benchmarks/brightness.py [--only biker,skull] [--ratio 0.1] [--presets default,fast]
        [--sizes 512,1600]

Eight automatic test views of each size over black, which no method learns from. The change of a
view is that of its mean colour, the largest of the channels, in 255ths.
"""

import argparse
from collections.abc import Sequence

import numpy as np

import nanogs
from measurements import SCENES, UP, made_before
from nanogs._types import F32, F64
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, prepare, render
from nanogs.views.automatic import automatic_cameras
from rivals import BUILD


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(SCENES))
    parser.add_argument("--ratio", type=float, default=0.1)
    parser.add_argument("--presets", default="default,fast")
    parser.add_argument("--sizes", default="512,1600")
    options = parser.parse_args()
    print("| scene | preset | pixels | largest | mean | views above 1 |")
    print("|---|---|--:|--:|--:|--:|")
    for name in options.only.split(","):
        original = nanogs.load(made_before(BUILD / "scenes" / f"{name}.ply"))
        cameras = automatic_cameras(original, 8, split="test", up=UP.get(name))
        prepared = prepare(original)
        for preset in options.presets.split(","):
            small = prepare(nanogs.simplify(original, ratio=options.ratio, preset=preset)[0])
            for size in map(int, options.sizes.split(",")):
                drift = drifts(prepared, small, [one.resized(size, size) for one in cameras])
                above = f"{(drift > 1).sum()} of {len(drift)}"
                cells = f"{size} | {drift.max():.2f} | {drift.mean():.2f} | {above}"
                print(f"| {name} | {preset} | {cells} |", flush=True)


def drifts(original: PreparedSplats, small: PreparedSplats, cameras: Sequence[Camera]) -> F64:
    """Compute the change (n,) of each view."""
    return np.array(
        [change(*(render(one, camera).shown() for one in (original, small))) for camera in cameras]
    )


def change(original: F32, result: F32) -> float:
    """Return the change of the mean colour between two images (H, W, 3), in 255ths."""
    changes = np.abs((result - original).mean(axis=(0, 1), dtype=np.float64))
    return float(changes.max() * 255)


if __name__ == "__main__":
    main()
