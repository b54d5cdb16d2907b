"""Make the documentation's screenshots of `nanogs studio`.

    python benchmarks/studio_pictures.py

The scene of `nanogs demo`, simplified to a twentieth, in Chromium: a page 1280 pixels wide as
docs/images/studio.jpg, and one of 390 pixels as docs/images/studio_phone.jpg.
"""

import argparse
import io
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import nanogs
from nanogs.datasets.plant import load_plant

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images"
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TIMEOUT = 300_000  # milliseconds
SPLATS = 5_682  # a twentieth
COARSE = 6  # number of coarse points that the studio adds to the plot while it is idle


def main() -> None:
    """Start a studio, open its page in two sizes, and save screenshots."""
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    browser = shutil.which("chromium") or sys.exit("This needs Chromium.")
    with _address() as address, sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=browser, args=SOFTWARE)
        for name, width, height in (("studio", 1280, 800), ("studio_phone", 390, 844)):
            size = {"width": width, "height": height}
            page = chromium.new_page(viewport=size, color_scheme="dark")  # type: ignore[arg-type]
            page.set_default_timeout(TIMEOUT)
            page.goto(address)
            _choose(page)
            picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            path = TARGET / f"{name}.jpg"
            picture.save(path, quality=88, optimize=True)
            print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")
            page.close()
        chromium.close()


def _choose(page: Page) -> None:
    """Type a count, and wait until the model, the plot and the image are final."""
    page.wait_for_selector("body[data-state=measured]")
    page.locator("#splats").fill(str(SPLATS))
    page.locator("#splats").press("Enter")
    page.wait_for_selector("body[data-state=coarse], body[data-state=measuring]")
    page.wait_for_selector("body[data-state=measured]")
    page.locator("#plot .point.coarse").nth(COARSE - 1).wait_for()
    page.get_by_text("Ready", exact=True).wait_for()
    page.wait_for_selector("#view[data-state=still]")


@contextmanager
def _address() -> Iterator[str]:
    """Start a studio with the scene, and yield its URL."""
    with tempfile.TemporaryDirectory() as folder:
        nanogs.save(load_plant(), Path(folder) / "plant.ply")
        command = [sys.executable, "-m", "nanogs", "studio", "plant.ply", "--no-open", "--json"]
        studio = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
        assert studio.stdout is not None
        output = ""
        while not output.endswith("}\n"):
            output += studio.stdout.readline() or sys.exit("The studio did not start.")
        try:
            yield json.loads(output)["url"]
        finally:
            studio.terminate()
            studio.wait()


if __name__ == "__main__":
    main()
