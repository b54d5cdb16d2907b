"""Make the pictures at the top of the README, and print the numbers below them.

    python benchmarks/readme_pictures.py

The scene of `nanogs demo` at 100, 10 and 1 %, each saved as .sog and read again. PSNR is that of
`nanogs compare` at its defaults. The pictures are written to docs/images, all from the same of its
test views.
"""

import argparse
import tempfile
from pathlib import Path

from PIL import Image

import nanogs
from nanogs.datasets.plant import load_plant
from nanogs.raster.images import to_bytes
from nanogs.views.automatic import automatic_cameras

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images"
RATIOS = (1.0, 0.1, 0.01)
PRESET = "best"
VIEW = 3  # index of the test view
SIDE = 560  # pixels


def main() -> None:
    """Simplify, save, read, compare and draw."""
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    original = load_plant()
    cameras = automatic_cameras(original, 8, width=SIDE, height=SIDE, split="test")
    TARGET.mkdir(exist_ok=True)
    for ratio in RATIOS:
        small, file_bytes = _packed(original, ratio)
        path = TARGET / f"plant_{100 * ratio:g}.jpg"
        [picture] = nanogs.render(small, [cameras[VIEW]])
        Image.fromarray(to_bytes(picture)).save(path, quality=90, optimize=True)
        psnr = nanogs.compare(original, small).models[0].psnr
        print(f"{path.name}: {len(small):,} splats, {file_bytes / 1e6:.2f} MB, {psnr:.1f} dB")


def _packed(original: nanogs.Splats, ratio: float) -> tuple[nanogs.Splats, int]:
    """Simplify and save as .sog; return the model read back, and the file's bytes."""
    small = original if ratio == 1 else nanogs.simplify(original, ratio=ratio, preset=PRESET)[0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.sog"
        nanogs.save(small, path)
        return nanogs.load(path), path.stat().st_size


if __name__ == "__main__":
    main()
