"""Measure which share of the error of a brief fit is left after a whole one.

    python benchmarks/brief_fits.py [SCENES] [--only kitchen,biker,plant] [--counts 30000,80000]

Results that a search for a size only compares have a brief fit. The error is that of the quality by
which they are compared, PSNR + 50 SSIM of the unpacked result on the views to choose by, as
10^(-quality / 10).
"""

import argparse
import math
from pathlib import Path

import nanogs
from measurements import SCENES
from nanogs.method.choose import quality
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.options.presets import parameters, with_longer_fit
from nanogs.pipeline.options.settings import BRIEF, LEAST_STEPS
from nanogs.scoring.held_out import selection_views
from rivals import REAL_SCENES


def main() -> None:
    """Print a row for each scene, count and preset."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=REAL_SCENES)
    parser.add_argument("--only", default="kitchen,biker,plant")
    parser.add_argument("--counts", default="30000,80000")
    options = parser.parse_args()
    print("| scene | splats | preset | steps | PSNR | left of the error |\n" + "|---" * 6 + "|")
    for name in options.only.split(","):
        model = nanogs.load(options.scenes / SCENES[name])
        views = selection_views(model)
        for count in map(int, options.counts.split(",")):
            for preset in "default", "best":
                whole = with_longer_fit(preset, {})
                chosen = parameters(preset, whole)
                assert isinstance(chosen, ForestParameters)
                steps = max(math.ceil(BRIEF * chosen.steps), LEAST_STEPS)
                brief = whole | {"steps": steps, "corrections": 0}
                found = []
                for changes in brief, whole:
                    small, _ = nanogs.simplify(model, count=count, preset=preset, **changes)
                    found.append(views.judge(small))
                left = 10 ** ((quality(*found[0]) - quality(*found[1])) / 10)
                row = (
                    *(name, f"{count:,}", preset, f"{steps} -> {chosen.steps}"),
                    *(f"{found[0][0]:.2f} -> {found[1][0]:.2f}", f"{left:.2f}"),
                )
                print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
