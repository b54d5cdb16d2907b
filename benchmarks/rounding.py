"""Measure rounding by rate and distortion: bytes and PSNR of one fitted model in files.

    python benchmarks/rounding.py [SCENES] [--only guitar,chair] [--ratio 0.1] [--bits 5,6,7]
        [--formats sog,spz] [--coarseness 0.5,1,2] [--steps 84]

A scene is simplified by `default` and refitted for one round of so many steps, each on a view of
its own. The scene "cloud" is made up: 20,000 splats that hide each other. All files hold that
model, without harmonics. "nearest" rounds each value to the nearest that the format holds; the
other rows choose values by what shows, at a coarseness. PSNR is that of `nanogs compare` on
automatic and roaming views.
"""

import argparse
from pathlib import Path

import numpy as np

import nanogs
from measurements import SCENES
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.rounds import fit
from nanogs.fit.views import view_targets
from nanogs.io import economical, round_trip_with_size
from nanogs.progress import ignore_progress
from rivals import REAL_SCENES

CLOUD = "cloud"


def make_cloud(count: int = 20_000) -> nanogs.Splats:
    """Make a cloud of splats, denser in the middle, whose colours follow their place."""
    rng = np.random.default_rng(1)
    means = rng.normal(0, 0.4, (count, 3))
    return nanogs.Splats(
        means=means.astype(np.float32),
        log_scales=rng.normal(-2, 0.2, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(2, 0.5, count).astype(np.float32),
        sh=(1.2 * np.sin(3 * means)[:, None]).astype(np.float32),
    )


def main() -> None:
    """Print a row for each scene, format, number of bits and way of rounding."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=REAL_SCENES)
    parser.add_argument("--only", default="guitar,chair,biker,kitchen")
    parser.add_argument("--ratio", type=float, default=0.1)
    parser.add_argument("--bits", default="5,6,7")
    parser.add_argument("--formats", default="sog,spz")
    parser.add_argument("--coarseness", default="0.5,1,2")
    parser.add_argument("--steps", type=int, default=84)
    options = parser.parse_args()
    print("| scene | format | bits | rounding | bytes | automatic | roaming |")
    print("|---" * 3 + "|---" + "|--:" * 3 + "|")
    for name in options.only.split(","):
        path = options.scenes / SCENES.get(name, "")
        model = make_cloud() if name == CLOUD else nanogs.load(path)
        model = model.with_sh_degree(0)
        small, _ = nanogs.simplify(model, ratio=options.ratio)
        steps = RefitParameters(views=options.steps, steps=options.steps, rounds=1)
        fitting, deciding, _ = view_targets(model, small, None, steps, ignore_progress)
        small, curvatures, _ = fit(small, fitting, deciding, steps, ignore_progress)
        for suffix in options.formats.split(","):
            path = Path(f"model.{suffix}")
            for bits in map(int, options.bits.split(",")):
                given, ways = {"bits": bits}, {"nearest": small}
                for each in options.coarseness.split(","):
                    ways[each] = economical(small, curvatures, path, given, float(each))
                for way, rounded in ways.items():
                    stored, size = round_trip_with_size(rounded, path, given)
                    auto, roam = (
                        nanogs.compare(model, stored, cameras=kind).models[0].psnr
                        for kind in ("auto", "roam")
                    )
                    row = name, f".{suffix}", bits, way, f"{size:,}", f"{auto:.2f}", f"{roam:.2f}"
                    print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    main()
