"""Frames a second of gsplat on a graphics card: originals, and what nanogs makes of them.

    python benchmarks/frames.py MODEL ... [--ratios 0.1,0.01] [--preset default] [--device auto]
                                [--pixels 1280x720] [--views 8]

It needs PyTorch and gsplat, and a card that CUDA can use. Frames are rendered in sequence from
automatic test views, five times each, as `nanogs bench` does for its column. The table on stdout
has the frames a second of each model, and how many times as fast that is as the original.
"""

import argparse
from pathlib import Path

import nanogs
from nanogs.bench.gsplat import gsplat_fps
from nanogs.cli.parsing import parse_pixels
from nanogs.raster.camera import Camera
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras


def main() -> None:
    """Print a row for each model."""
    options = arguments()
    ratios = [float(text) for text in options.ratios.split(",")]
    width, height = parse_pixels(options.pixels)
    print("| scene | splats | frames/s |", *(f"at {ratio:g} | times |" for ratio in ratios))
    print("|---|" + "--:|" * (2 + 2 * len(ratios)))
    for model in options.models:
        splats = nanogs.load(model)
        cameras = automatic_cameras(splats, options.views, width=width, height=height, split="test")
        rates = [frames(splats, cameras)]
        for ratio in ratios:
            small, _ = nanogs.simplify(
                splats, ratio=ratio, preset=options.preset, device=options.device
            )
            rates.append(frames(small, cameras))
        cells = (f"{rate:,.0f} | {rate / rates[0]:.1f} |" for rate in rates[1:])
        print(f"| {Path(model).name} | {len(splats):,} | {rates[0]:,.0f} |", *cells, flush=True)


def frames(model: Splats, cameras: list[Camera]) -> float:
    """Measure the frames a second of a model."""
    rate = gsplat_fps(model, cameras)
    if rate is None:
        raise SystemExit("PyTorch, gsplat or a graphics card is missing, or gsplat failed.")
    return rate


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="+")
    parser.add_argument("--ratios", default="0.1,0.01", help="with commas between")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--pixels", default="1280x720")
    parser.add_argument("--views", type=int, default=8)
    return parser.parse_args()


if __name__ == "__main__":
    main()
