"""How far the brightness of whole views drifts: nine real scenes, after `quality.py` made them.

    python benchmarks/brightness.py [--only biker,skull] [--ratio 0.1] [--presets default,fast]

Eight automatic views of 320 x 320 over black that no method learns from; the change of a view's
mean colour, largest of its channels, in 255ths.
"""

import argparse

import numpy as np

import nanogs
from measured import SCENES, UP
from nanogs._types import F32
from nanogs.render.rasterize import prepare, render
from nanogs.render.views import automatic_cameras
from rivals import BUILD


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(SCENES))
    parser.add_argument("--ratio", type=float, default=0.1)
    parser.add_argument("--presets", default="default,fast")
    options = parser.parse_args()
    print("| scene | preset | largest | mean | views above 1 |\n|---|---|--:|--:|--:|")
    for name in options.only.split(","):
        original = nanogs.load(BUILD / "scenes" / f"{name}.ply")
        cameras = automatic_cameras(
            original, 8, width=320, height=320, split="test", up=UP.get(name)
        )
        prepared = prepare(original)
        wanted = [render(prepared, camera).shown() for camera in cameras]
        for preset in options.presets.split(","):
            small = prepare(nanogs.simplify(original, ratio=options.ratio, preset=preset)[0])
            shown = [render(small, camera).shown() for camera in cameras]
            drift = np.array([change(*pair) for pair in zip(wanted, shown, strict=True)])
            cells = f"{drift.max():.2f} | {drift.mean():.2f} | {(drift > 1).sum()} of {len(drift)}"
            print(f"| {name} | {preset} | {cells} |", flush=True)


def change(wanted: F32, shown: F32) -> float:
    """Change of the mean colour from one image (H, W, 3) to the other, in 255ths."""
    changes = np.abs((shown - wanted).mean(axis=(0, 1), dtype=np.float64))
    return float(changes.max() * 255)


if __name__ == "__main__":
    main()
