"""Chromium for tests that look at a page: drawn by the processor, and watched for errors."""

import contextlib
import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
# WebGL by the processor: machines without a graphics card draw the same.
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE = 60_000  # milliseconds


@contextlib.contextmanager
def page_at(address, width, height):
    """The page of an address; an error in it fails the test, which is skipped without Chromium."""
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    from playwright.sync_api import sync_playwright

    faults = []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM, args=[*SOFTWARE, "--ignore-gpu-blocklist"]
        )
        page = browser.new_page(viewport={"width": width, "height": height})
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda said: faults.append(said.text) if said.type == "error" else None)
        page.goto(address)
        yield page
        browser.close()
    assert faults == []


def pixels_of(seen, name, **options):
    """Picture of a page or a part of it, (H, W, 3) float32 in [0, 1]; kept where one asks for it.

    Args:
        seen: The page, or what a locator of it finds.
        name: Of the picture in the folder that the environment's NANOGS_SCREENSHOTS names.
        **options: As the driver takes them.
    """
    picture = seen.screenshot(**options)
    if kept := os.environ.get("NANOGS_SCREENSHOTS"):
        Path(kept, f"{name}.png").write_bytes(picture)
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"), dtype=np.float32) / 255
