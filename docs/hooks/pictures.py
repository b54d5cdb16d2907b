"""The pictures and numbers of the tutorial: the demo scene, simplified."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from io import BytesIO

import numpy as np

import nanogs
from nanogs._types import F32, U8
from nanogs.charts import Chart, narrow_svg
from nanogs.datasets.plant import load_plant
from nanogs.raster.camera import Camera
from nanogs.raster.images import to_bytes
from nanogs.raster.rendering import render
from nanogs.scoring.comparison import Comparison, NamedModel, compare_models
from nanogs.scoring.pictures import error_map
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras

RATIOS = (0.25, 0.1, 0.03)
WIDTH, HEIGHT, VIEWS = 480, 480, 4
SHOWN = 1  # of the views

_DARK = "@media (prefers-color-scheme: dark) { svg { color: #ddd } rect { fill: none } }"

NAMES = ("original.png", "tenth.png", "random.png", "difference.png", "curve.svg")


@dataclass(frozen=True, slots=True)
class Tutorial:
    """What the tutorial shows.

    Attributes:
        pictures: Files by name.
        scores: A table in Markdown.
    """

    pictures: Mapping[str, bytes]
    scores: str


@cache
def make() -> Tutorial:
    """Simplify, render and compare; the same bytes every time on one machine."""
    original = NamedModel("original", load_plant())
    levels = [
        NamedModel(f"{ratio:.0%}", small)
        for ratio, (small, _) in zip(RATIOS, nanogs.levels(original.splats, RATIOS), strict=True)
    ]
    tenth = levels[RATIOS.index(0.1)]
    chance = NamedModel("10%, at random", _at_random(original.splats, len(tenth.splats)))
    cameras = automatic_cameras(
        original.splats, VIEWS, width=WIDTH, height=HEIGHT, kind="orbit", split="test"
    )
    comparison, _ = compare_models(original, [*levels, chance], cameras)
    views = {
        name: _view(model.splats, cameras[SHOWN])
        for name, model in (("original", original), ("tenth", tenth), ("random", chance))
    }
    pictures = {f"{name}.png": _png(to_bytes(view)) for name, view in views.items()}
    pictures["difference.png"] = _png(to_bytes(error_map(views["original"], views["tenth"])))
    pictures["curve.svg"] = _curve(comparison)
    return Tutorial(pictures, _table(comparison))


def _at_random(splats: Splats, count: int) -> Splats:
    rows = np.random.default_rng(0).choice(len(splats), count, replace=False)
    return splats.take(np.sort(rows))


def _view(splats: Splats, camera: Camera) -> F32:
    return render(splats, camera).color


def _png(image: U8) -> bytes:
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def _curve(comparison: Comparison) -> bytes:
    """PSNR over the share of splats kept, in the reader's colour scheme."""
    shown = [model.psnr for model in comparison.models]
    lines = {
        "simplified": [(100 * ratio, psnr) for ratio, psnr in zip(RATIOS, shown, strict=False)],
        "at random": [(10.0, shown[-1])],
    }
    drawn = narrow_svg(Chart("", "splats kept, %", lines))
    return drawn.replace("<rect", f"<style>{_DARK}</style><rect", 1).encode()


def _table(comparison: Comparison) -> str:
    rows = ["| kept | splats | PSNR, dB | SSIM |", "|---|--:|--:|--:|"]
    rows += [
        f"| {model.name} | {model.splats:,} | {model.psnr:.2f} | {model.ssim:.3f} |"
        for model in comparison.models
    ]
    return "\n".join(rows)
