"""The comparison as one self-contained page: numbers, pictures, a rate-distortion plot."""

import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from nanogs.charts import Chart, svg
from nanogs.formatting import bytes_text, counted, number_text
from nanogs.scoring.comparison import Comparison, Sheet
from nanogs.scoring.pictures import ERROR_FULL_SCALE
from nanogs.scoring.scores import ModelScore
from nanogs.templates import template
from nanogs.view.page import POLICY

# Content security policy of a page without the viewer: its pictures are embedded.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def render_page(
    comparison: Comparison, sheets: Sequence[Sheet], title: str, viewer: str | None = None
) -> str:
    """Return the comparison as HTML that needs no other file and no network.

    Args:
        comparison: The numbers.
        sheets: The pictures, from `compare_models` with `Scoring(pictures=True)`.
        title: Heading of the page.
        viewer: From `nanogs.view.page.viewer_part`: an interactive part, which starts when a button
            is pressed; None for a page without it.
    """
    page = template(
        "nanogs.scoring", "page.html.j2", number=number_text, size=bytes_text, counted=counted
    )
    width, height = comparison.protocol.pixels
    plot = ""
    if len({model.splats for model in comparison.models}) > 1:
        plot = rate_distortion_plot(comparison.models, comparison.protocol_texts[0])
    return page.render(
        title=title,
        comparison=comparison,
        width=width,
        height=height,
        original="original" if comparison.reference_splats else "photograph",
        against=_against(comparison),
        named=comparison.protocol.kind in ("given", "photographs"),
        unpictured=len(comparison.each) > len({sheet.label for sheet in sheets}),
        css=_text("page.css"),
        program=_text("page.js"),
        policy=_POLICY,
        sheets=sheets,
        full_scale=ERROR_FULL_SCALE,
        extras=sorted({name for model in comparison.models for name in model.extras}),
        costs=all(model.cost for one in comparison.each for model in one.models),
        packed=any(model.packed for model in comparison.models),
        beside=_beside(comparison),
        viewer=viewer,
        viewer_policy=POLICY,
        plot=plot,
    )


def _against(comparison: Comparison) -> str:
    """Return the name of the reference; a page is published, so a folder is named without path."""
    whole = comparison.reference
    return whole if comparison.reference_splats else Path(whole).resolve().name


def _beside(comparison: Comparison) -> list[str]:
    """Return the names of the models that the interactive part shows beside the original.

    The first model of a comparison with photographs is the original itself.
    """
    names = [model.name for model in comparison.models if not model.packed]
    return names if comparison.reference_splats else names[1:]


def _text(name: str) -> str:
    return files("nanogs.scoring").joinpath(name).read_text(encoding="utf-8")


def rate_distortion_plot(models: Sequence[ModelScore], title: str = "") -> str:
    """Plot PSNR over the number of splats as an SVG element, with a line for each name.

    Models whose PSNR is infinite are left out, and those as packed files, which have the splats of
    another model and nearly its PSNR; the result is empty if none is left.

    Args:
        models: Their scores, all on the same views.
        title: Title of the plot, such as the text of these views' protocol.
    """
    lines: dict[str, list[tuple[float, float]]] = {}
    for model in models:
        if math.isfinite(model.psnr) and not model.packed:
            lines.setdefault(model.name, []).append((model.splats, model.psnr))
    return svg([Chart(title, "splats", lines)]) if lines else ""
