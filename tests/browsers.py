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


_kept_tabs = []  # the tab of `one_tab`, while that is open


@contextlib.contextmanager
def browser(*more):
    """Start Chromium with some more arguments; skip the test if it is absent."""
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=[*SOFTWARE, *more])
        try:
            yield chromium
        finally:
            chromium.close()


@contextlib.contextmanager
def one_tab():
    """Let `page_at` open all pages in one tab, one after the other.

    A new tab starts processes, and compiles a page's programs again, which takes about a second.
    """
    with browser("--ignore-gpu-blocklist") as chromium:
        _kept_tabs.append(chromium.new_page())
        try:
            yield
        finally:
            _kept_tabs.pop()


@contextlib.contextmanager
def page_at(address, width, height):
    """Open an address in Chromium, and yield the page.

    An error on the page fails the test; without Chromium, the test is skipped.
    """
    with contextlib.ExitStack() as stack:
        if not _kept_tabs:
            stack.enter_context(one_tab())
        page = _kept_tabs[-1]
        with without_errors(page):
            page.set_viewport_size({"width": width, "height": height})
            page.goto(address)
            yield page
            page.goto("about:blank")


@contextlib.contextmanager
def without_errors(page):
    """Fail if the page or its console has an error before the end of the block."""
    errors = []
    listeners = {
        "pageerror": lambda error: errors.append(str(error)),
        "console": lambda message: message.type == "error" and errors.append(message.text),
    }
    for event, listener in listeners.items():
        page.on(event, listener)
    try:
        yield
    finally:
        for event, listener in listeners.items():
            page.remove_listener(event, listener)
    assert errors == [], errors


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
