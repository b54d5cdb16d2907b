"""`.rad` files opened with Spark's npm package in a real browser."""

import dataclasses

import numpy as np
import pytest

import nanogs
from builders import random_splats
from conftest import scene_path
from nanogs import io
from nanogs.metrics import psnr
from nanogs.raster.rendering import render
from spark_page import render_in_spark
from views_and_scores import opening_camera

pytestmark = [
    pytest.mark.usefixtures("one_tab"),
    pytest.mark.filterwarnings("default"),  # the driver's own warnings are not ours
]


def three_clusters(count=400):
    """Three clusters of different colours and sizes, with view-dependent colours."""
    model = random_splats(count, degree=2, seed=8, spread=0.3)
    cluster = np.arange(count) % 3
    centres = np.array([[-1, -0.4, 0.1], [0.9, 0.6, -0.3], [0.3, -0.9, 0.5]], np.float32)
    sh = model.sh * np.float32(0.15)
    sh[:, 0] = np.eye(3, dtype=np.float32)[cluster] * 3 - 1.5
    return dataclasses.replace(
        model,
        means=(model.means * (1 + cluster[:, None]) / 2 + centres[cluster]).astype(np.float32),
        log_scales=(model.log_scales - np.log(count / 400) / 2).astype(np.float32),
        sh=sh,
        opacity_logits=np.full(count, 1.5, np.float32),
    )


def test_spark_draws_what_nanogs_renders(tmp_path):
    model = three_clusters()
    camera = opening_camera(model)
    nanogs.save(model, tmp_path / "a.rad")
    rendered = render(io.load(tmp_path / "a.rad"), camera).shown()
    shown, state = render_in_spark(tmp_path / "a.rad", camera, tmp_path)
    assert (state["splats"], state["total"]) == (len(model), len(model))
    assert (rendered.max(axis=2) > 0.2).mean() > 0.05
    assert psnr(shown, rendered) > 35
    for other in (shown[::-1], shown[:, ::-1], shown[..., ::-1]):  # the PSNR detects these errors
        assert psnr(other, rendered) < 25


@pytest.mark.slow
def test_spark_draws_a_real_model_as_nanogs_renders_it(tmp_path):
    model = nanogs.load(scene_path("biker.spz"))
    model = model.take(np.arange(0, len(model), 4))
    camera = opening_camera(model, 160, 160)
    nanogs.save(model, tmp_path / "a.rad")
    shown, _ = render_in_spark(tmp_path / "a.rad", camera, tmp_path, still_frames=3)
    assert psnr(shown, render(model, camera).shown()) > 40
