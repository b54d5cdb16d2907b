"""Compare level-of-detail trees in Spark at equal numbers of splats: ours, and Spark's own.

    python benchmarks/spark.py [--scenes biker.spz,plant.splat] [--shares 0.25,0.1] [--views 2]

Each model is written as `.rad`, like `nanogs lod` does, and as `.spz`, from which Spark (its npm
package) builds a tree itself: `lod: true`, its quick method, and `lod: "quality"`. All are drawn in
Chromium from the same cameras with the same maximum number of splats (`lodSplatCount`), and
compared with our renders of the whole model. The page is that of `tests/spark_page.py`.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rivals import REAL_SCENES, ROOT

SCENES = "biker.spz,plant.splat,kitchen.spz"
RATIOS = (1, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015)
PIXELS = 240
OWN: dict[str, dict[str, Any]] = {"quick": {"lod": True}, "quality": {"lod": "quality"}}


def main() -> None:
    """Print a table with a row for each scene and number of splats."""
    options = _options()
    sys.path.insert(0, str(ROOT / "tests"))
    print("| scene | splats | drawn | nanogs | Spark, quick | Spark, quality |")
    print("|---|---|---|---|---|---|")
    for scene in options.scenes.split(","):
        shares = [float(share) for share in options.shares.split(",")]
        with tempfile.TemporaryDirectory() as temporary_folder:
            try:
                _compare(
                    REAL_SCENES / scene,
                    Path(temporary_folder),
                    shares,
                    options.views,
                    options.preset,
                )
            except pytest.skip.Exception as missing:  # Node, Chromium or the package is absent
                sys.exit(str(missing))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenes", default=SCENES, help="files, with commas between")
    parser.add_argument("--shares", default="0.25,0.1", help="of the splats that are drawn")
    parser.add_argument("--views", type=int, default=2, help="automatic cameras")
    parser.add_argument("--preset", default="fast", help="of nanogs lod")
    return parser.parse_args()


def _compare(path: Path, folder: Path, shares: list[float], views: int, preset: str) -> None:
    import nanogs
    from nanogs.metrics import psnr
    from nanogs.raster.rendering import render
    from nanogs.splats import RenderMode
    from nanogs.views.automatic import automatic_cameras
    from spark_page import render_in_spark

    model = nanogs.load(path)
    nanogs.write_levels(model, folder / "a.rad", RATIOS, layout="spark tree", preset=preset)
    nanogs.save(model, folder / "a.spz")
    mip = model.render_mode is RenderMode.MIP
    blurs = {"preBlurAmount": 0, "blurAmount": 0.3} if mip else {}
    cameras = automatic_cameras(model, views, width=PIXELS, height=PIXELS)
    targets = [render(model, camera).shown() for camera in cameras]
    for share in shares:
        count = int(len(model) * share)
        ways: dict[str, tuple[Path, dict[str, Any]]] = {"nanogs": (folder / "a.rad", {})}
        ways |= {name: (folder / "a.spz", mesh) for name, mesh in OWN.items()}
        cells = []
        for file, mesh in ways.values():
            found = []
            for camera, target in zip(cameras, targets, strict=True):
                shown, state = render_in_spark(
                    file, camera, folder, mesh=mesh, still_frames=4, lodSplatCount=count, **blurs
                )
                found.append((psnr(shown, target), state["splats"]))
            mean, drawn = np.mean(found, axis=0)
            cells.append(f"{mean:.2f} dB ({drawn:,.0f})")
        print(f"| {path.stem} | {len(model):,} | {count:,} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
