"""Chromium for tests that open a page: it renders on the CPU, and page errors fail the test."""

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
# WebGL in software, so that machines without a graphics card render the same pictures.
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
TIMEOUT = 60_000  # timeout, milliseconds


@contextlib.contextmanager
def page_at(address, width, height):
    """Open an address in Chromium, and yield the page.

    An error on the page fails the test; without Chromium, the test is skipped.
    """
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    from playwright.sync_api import sync_playwright

    errors = []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM, args=[*SOFTWARE, "--ignore-gpu-blocklist"]
        )
        page = browser.new_page(viewport={"width": width, "height": height})
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on(
            "console",
            lambda message: errors.append(message.text) if message.type == "error" else None,
        )
        page.goto(address)
        yield page
        browser.close()
    assert errors == []


def pixels_of(element, name, **options):
    """Take a picture of a page or a part of it, (H, W, 3) float32 in [0, 1].

    Args:
        element: The page, or a locator of one of its elements.
        name: Name of the picture in the folder of the environment variable NANOGS_SCREENSHOTS;
            without this variable, no picture is kept.
        **options: Options of Playwright's `screenshot`.
    """
    picture = element.screenshot(**options)
    if folder := os.environ.get("NANOGS_SCREENSHOTS"):
        Path(folder, f"{name}.png").write_bytes(picture)
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"), dtype=np.float32) / 255
