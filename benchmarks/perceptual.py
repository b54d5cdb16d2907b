"""Measure LPIPS of our presets and of splat-transform's results, which `quality.py` must have made.

    python benchmarks/perceptual.py [--only biker,skull] [--ratios 0.1,0.01]

Needs the extra `lpips`. Each scene has four automatic test views of 256 x 256, which no method
learns from; each cell is AlexNet / VGG, lower is better.
"""

import argparse

import numpy as np

import nanogs
from measurements import SCENES, UP, made_before, result_file
from nanogs.metrics import lpips
from nanogs.raster.rendering import prepare, render
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras
from rivals import BUILD, RIVALS, rival_version

PRESETS = ("default", "best")


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(SCENES))
    parser.add_argument("--ratios", default="0.1")
    options = parser.parse_args()
    print("| scene | ratio |", " | ".join((*RIVALS, *PRESETS)), "|")
    print("|---|--:|" + "--:|" * (len(RIVALS) + len(PRESETS)))
    for name in options.only.split(","):
        original = nanogs.load(made_before(BUILD / "scenes" / f"{name}.ply"))
        for ratio in options.ratios.split(","):
            files = (
                result_file(BUILD, name, float(ratio), method, rival_version()) for method in RIVALS
            )
            models = [nanogs.load(made_before(file)) for file in files]
            models += [nanogs.simplify(original, ratio=float(ratio), preset=p)[0] for p in PRESETS]
            cells = (distances(original, model, UP.get(name)) for model in models)
            print(f"| {name} | {ratio} |", " | ".join(cells), "|", flush=True)


def distances(original: Splats, model: Splats, up: tuple[float, float, float] | None) -> str:
    """Return the mean LPIPS over the views, with either backbone."""
    cameras = automatic_cameras(original, 4, width=256, height=256, split="test", up=up)
    first, second = prepare(original), prepare(model)
    pairs = [(render(first, c).shown(), render(second, c).shown()) for c in cameras]
    means = [np.mean([lpips(*pair, net=net) for pair in pairs]) for net in ("alex", "vgg")]
    return f"{means[0]:.4f} / {means[1]:.4f}"


if __name__ == "__main__":
    main()
