"""Make the pictures at the head of the README, and print the numbers below them.

    python benchmarks/front.py

The scene of `nanogs demo` at 100, 10 and 1 %, each saved as .sog and read again. PSNR is that of
`nanogs compare` at its defaults. Pictures go to docs/images, all from one of its views.
"""

import tempfile
from pathlib import Path

from PIL import Image

import nanogs
from nanogs.compare.comparison import NamedModel, compare_models
from nanogs.datasets.plant import load_plant
from nanogs.render.camera import Camera
from nanogs.render.images import to_bytes
from nanogs.render.rasterize import render
from nanogs.render.source import cameras_for
from nanogs.splats import Splats

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images"
RATIOS = (1.0, 0.1, 0.01)
PRESET = "best"
VIEW = 3
PIXELS = 560


def main() -> None:
    """Simplify, save, read, compare and draw."""
    original = load_plant()
    cameras, shown = _cameras(original, 512), _cameras(original, PIXELS)[VIEW]
    TARGET.mkdir(exist_ok=True)
    for ratio in RATIOS:
        small, taken = _packed(original, ratio)
        comparison, _ = compare_models(
            NamedModel("original", original), [NamedModel("small", small)], cameras
        )
        path = TARGET / f"plant_{100 * ratio:g}.jpg"
        _draw(small, shown, path)
        psnr = comparison.models[0].psnr
        print(f"{path.name}: {len(small):,} splats, {taken / 1e6:.2f} MB, {psnr:.1f} dB")


def _cameras(original: Splats, pixels: int) -> list[Camera]:
    return cameras_for(original, "auto", count=8, width=pixels, height=pixels, split="test")


def _packed(original: Splats, ratio: float) -> tuple[Splats, int]:
    """A model of so many of the splats as its file has it, and the bytes of that."""
    small = original if ratio == 1 else nanogs.simplify(original, ratio=ratio, preset=PRESET)[0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.sog"
        nanogs.save(small, path)
        return nanogs.load(path), path.stat().st_size


def _draw(splats: Splats, camera: Camera, path: Path) -> None:
    image = to_bytes(render(splats, camera).shown())
    Image.fromarray(image).save(path, quality=90, optimize=True)


if __name__ == "__main__":
    main()
