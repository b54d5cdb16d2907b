"""Compare a graphics card with the CPU: time of presets, frame rate, and quality of results.

    python benchmarks/card.py [MODEL] [--count 1000000] [--device cuda] [--presets default,best]
                              [--rounds 3] [--ratio 0.1] [--pixels 1280x720] [--frames 50]

MODEL is a 3DGS file; without one, a scene of --count splats of SH degree 3 is generated. Each
device runs everything once before it is timed, to compile kernels and allocate memory. Devices
alternate. The table on stdout has medians of whole calls of `nanogs.simplify` without files, and
the PSNR of `nanogs compare`, measured on the CPU. Images are rendered in sequence, and copied to
the host.
"""

import argparse
import time
from statistics import median

import nanogs
from nanogs.card.device import use_device
from nanogs.cli.parsing import parse_pixels
from nanogs.datasets.synthetic import make_scene
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare, render
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras


def main() -> None:
    """Print a table of presets, and one of frame rates."""
    options = arguments()
    splats = nanogs.load(options.model) if options.model else make_scene(options.count)
    devices = ["cpu", options.device]
    with use_device(options.device) as used:
        print(f"{len(splats):,} splats of degree {splats.sh_degree}; {options.device}: {used}\n")
    print("| preset | device | seconds | times as fast | dB |\n|---|---|--:|--:|--:|")
    small = {}
    for preset in options.presets.split(","):
        seconds: dict[str, list[float]] = {device: [] for device in devices}
        for turn in range(options.rounds + 1):
            for device in devices:
                begin = time.perf_counter()
                small[device], _ = nanogs.simplify(
                    splats, ratio=options.ratio, preset=preset, device=device
                )
                seconds[device] += [time.perf_counter() - begin] if turn else []
        for device in devices:
            took, first = median(seconds[device]), median(seconds["cpu"])
            psnr = nanogs.compare(splats, small[device]).models[0].psnr
            print(f"| {preset} | {device} | {took:.2f} | {first / took:.1f} | {psnr:.3f} |")
    width, height = parse_pixels(options.pixels)
    cameras = automatic_cameras(splats, 8, width=width, height=height)
    print(f"\n| {width} x {height} | device | frames a second |\n|---|---|--:|")
    for name, model in (("original", splats), ("simplified", small["cpu"])):
        for device in devices:
            rate = frames(model, cameras, device, options.frames)
            print(f"| {name}, {len(model):,} | {device} | {rate:.1f} |")


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?")
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--presets", default="default,best", help="with commas between")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--ratio", type=float, default=0.1)
    parser.add_argument("--pixels", default="1280x720")
    parser.add_argument("--frames", type=int, default=50)
    return parser.parse_args()


def frames(model: Splats, cameras: list[Camera], device: str, count: int) -> float:
    """Measure the frames per second of a model that is prepared once."""
    prepared = prepare(model)
    with use_device(device):
        for camera in cameras:
            render(prepared, camera)
        begin = time.perf_counter()
        for number in range(count):
            render(prepared, cameras[number % len(cameras)])
    return count / (time.perf_counter() - begin)


if __name__ == "__main__":
    main()
