"""HTML of the viewer: a complete page, and a part to embed in other pages."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nanogs._version import __version__
from nanogs.errors import ModelError
from nanogs.formatting import bytes_text, counted, number_text
from nanogs.protocol import Background, Judged, hex_text
from nanogs.templates import template
from nanogs.view.bundle import licences, program
from nanogs.view.pack import Packed, camera_in_page
from nanogs.views.opening import Opening

MOST_TEXT = 500_000_000  # characters of base64; a browser's strings have at most 536,870,888
# Content security policy: only what the viewer needs within the page, and no network requests.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; worker-src blob:;"
    " connect-src data: blob:; img-src data: blob:; style-src 'unsafe-inline'"
)


@dataclass(frozen=True, slots=True)
class Shown:
    """A model of a page, with the lines of text that the page shows for it.

    Attributes:
        name: Its name; if empty, the page's file gives it.
        facts: Lines of text: number of splats, file size, quality.
        packed: The model.
    """

    name: str
    facts: tuple[str, ...]
    packed: Packed


def facts_of(
    splats: int,
    file_bytes: int | None,
    *,
    reference: int | None = None,
    judged: Judged | None = None,
) -> tuple[str, ...]:
    """Return the lines of text that a page shows for a model.

    Args:
        splats: Number of splats.
        file_bytes: Size of its file.
        reference: Splats of the page's first model; None for the first model itself.
        judged: Scores of the model against the first.
    """
    share = ""
    if reference and splats < reference:
        share = f" ({number_text(100 * splats / reference)}\N{NO-BREAK SPACE}%)"
    quality: tuple[str, ...] = ()
    if judged is not None:
        quality = (f"PSNR {number_text(judged.psnr)} dB", f"on {judged.protocol.text}")
    return (counted(splats, "splat") + share, bytes_text(file_bytes), *quality)


def viewer_part(models: Sequence[Shown], start: Opening, background: Background) -> str:
    """Return HTML with viewer and models; `nanogs.start()` shows them in the element `nanogs-view`.

    Args:
        models: The first is shown on the left, one of the others at a time on the right.
        start: The first view.
        background: RGB in [0, 1].

    Raises:
        ModelError: A model is too large for a browser.
        OptionError: The viewer was not built.
    """
    texts = []
    for model in models:
        texts.append(base64.b64encode(model.packed.data).decode("ascii"))
        if len(texts[-1]) > MOST_TEXT:
            raise ModelError(
                f"{model.name} is too large for a page ({bytes_text(len(texts[-1]))} as text, and"
                f" browsers hold {bytes_text(MOST_TEXT)}); simplify it first."
            )
    return template("nanogs.view", "viewer.html.j2").render(
        licences=licences(),
        scene=_scene(models, start, background),
        models=texts,
        program=program(),
    )


def render_page(models: Sequence[Shown], start: Opening, background: Background) -> str:
    """Return a self-contained page, which needs no network; arguments as for `viewer_part`.

    Raises:
        ModelError: A model is too large for a browser.
        OptionError: The viewer was not built.
    """
    from markupsafe import Markup

    return template("nanogs.view", "page.html.j2").render(
        title=" and ".join(model.name for model in models) or "Model",
        background=hex_text(background),
        policy=POLICY,
        version=__version__,
        viewer=Markup(viewer_part(models, start, background)),  # noqa: S704 - escaped there
    )


def _scene(models: Sequence[Shown], start: Opening, background: Background) -> dict[str, Any]:
    """Return the viewer's JSON data, in units of the page."""
    return {
        "models": [
            {
                "id": f"nanogs-model-{index}",
                "name": model.name,
                "facts": list(model.facts),
                "mip": model.packed.mip,
            }
            for index, model in enumerate(models)
        ],
        "camera": camera_in_page(start),
        "background": hex_text(background),
    }
