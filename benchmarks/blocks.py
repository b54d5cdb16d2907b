"""Compare the quality of simplifying in blocks and in memory, on real scenes.

    python benchmarks/blocks.py                              # default, six blocks, a tenth
    python benchmarks/blocks.py --preset best --scenes biker,kitchen --blocks 4

Prints a table in Markdown: PSNR in memory, and its change in blocks, on automatic views of 512 and
1600 pixels and on roaming ones, which no method learns from.
"""

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import nanogs
from measurements import SCENES
from nanogs.metrics import psnr
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, prepare, render
from nanogs.scoring.scores import mean_psnr
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras
from nanogs.views.roam import roaming_cameras
from rivals import ROOT


def cameras_of(splats: Splats) -> dict[str, list[Camera]]:
    """Return test views of each kind, by name of the kind."""
    large = automatic_cameras(splats, 8, width=1600, height=1600, split="test")
    return {
        "512": automatic_cameras(splats, 8, width=512, height=512, split="test"),
        "1600": large[1::2],
        "roaming": roaming_cameras(splats, 16, width=512, height=512, split="test"),
    }


def scores(
    original: PreparedSplats, small: Splats, cameras: Mapping[str, Sequence[Camera]]
) -> list[float]:
    """Compute the mean PSNR on each kind of views, dB."""
    model = prepare(small)
    return [
        mean_psnr([_psnr(original, model, camera) for camera in each]) for each in cameras.values()
    ]


def _psnr(original: PreparedSplats, small: PreparedSplats, camera: Camera) -> float:
    return psnr(render(original, camera).shown(), render(small, camera).shown())


def measure(path: Path, preset: str, ratio: float, blocks: int) -> tuple[list[float], list[float]]:
    """Return the scores of the result made in memory and of the result made in blocks."""
    splats = nanogs.load(path)
    splats = replace(splats.take(splats.finite()), elements=())
    cameras, drawn = cameras_of(splats), prepare(splats)
    whole, _ = nanogs.simplify(splats, ratio=ratio, preset=preset)
    with tempfile.TemporaryDirectory() as name:
        source, target = Path(name) / "in.ply", Path(name) / "out.ply"
        nanogs.save(splats, source)
        block = int(len(splats) / blocks * 1.07)
        nanogs.simplify_blocks(source, target, ratio=ratio, preset=preset, block=block)
        divided = nanogs.load(target)
    return scores(drawn, whole, cameras), scores(drawn, divided, cameras)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--preset", default="default")
    parser.add_argument("--ratio", type=float, default=0.1)
    parser.add_argument("--blocks", type=int, default=6)
    parser.add_argument("--folder", type=Path, default=ROOT.parent / "shared" / "scenes")
    options = parser.parse_args()
    print(f"| `{options.preset}` | 512 | 1600 | roaming |\n|---|--:|--:|--:|")
    changes = []
    for scene in options.scenes.split(","):
        model = options.folder / SCENES[scene]
        whole, divided = measure(model, options.preset, options.ratio, options.blocks)
        changes.append(np.subtract(divided, whole))
        cells = (f"{a:.2f} {b:+.2f}" for a, b in zip(whole, changes[-1], strict=True))
        print(f"| {scene} | {' | '.join(cells)} |", flush=True)
    for name, values in (("mean", np.mean(changes, 0)), ("least", np.min(changes, 0))):
        print(f"| {name} | {' | '.join(f'{value:+.2f}' for value in values)} |")


if __name__ == "__main__":
    main()
