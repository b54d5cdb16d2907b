"""Renders of a trained model against the photographs it was trained for.

This checks conventions that the plain rasteriser of the tests shares with the kernels: pixel
centres, the order wxyz, the signs of the axes.
"""

import json
import math
from functools import cache

import numpy as np
import pytest

from conftest import scene_path
from nanogs.kernels.harmonics import C0
from nanogs.metrics import psnr
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare, render
from nanogs.splats import Splats

EXPECTED = {0: 25.6, 10: 24.9, 50: 23.0, 120: 22.7}  # dB, of the reference rasteriser
EXPECTED_MEAN = 23.9


@cache
def chair():
    fields = [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
    rows = np.fromfile(scene_path("chair.splat"), np.dtype(fields))
    alpha = rows["rgba"][:, 3] / 255
    with np.errstate(divide="ignore"):
        logits = np.log(alpha) - np.log1p(-alpha)
    return prepare(
        Splats(
            means=rows["means"].copy(),
            log_scales=np.log(rows["scales"]),
            quats=(rows["quats"].astype(np.float32) - 128) / 128,
            opacity_logits=logits.astype(np.float32),
            sh=((rows["rgba"][:, None, :3] / 255 - 0.5) / C0).astype(np.float32),
        )
    )


@cache
def photo_psnr(view):
    """Return the PSNR of one test view over white, clipped to the range of a display."""
    image_module = pytest.importorskip("PIL.Image")
    folder = scene_path("chair_photos")
    poses = json.loads((folder / "transforms_test.json").read_text())
    frame = next(f for f in poses["frames"] if f["file_path"].endswith(f"/r_{view}"))
    with image_module.open(folder / f"{frame['file_path']}.png") as photo:
        rgba = np.asarray(photo.convert("RGBA")) / 255
    to_world = np.array(frame["transform_matrix"])
    to_world[:3, 1:3] *= -1  # from OpenGL's y up, z back
    height, width = rgba.shape[:2]
    focal = 0.5 * width / math.tan(0.5 * poses["camera_angle_x"])
    pose = np.linalg.inv(to_world)
    camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
    image = render(chair(), camera, background=(1.0, 1.0, 1.0)).color.clip(0, 1)
    return psnr(rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:], image.astype(np.float64))


@pytest.mark.parametrize("view", EXPECTED)
def test_the_psnr_of_the_chair_is_that_of_the_reference_rasteriser(view):
    assert photo_psnr(view) == pytest.approx(EXPECTED[view], abs=0.2)


def test_the_mean_psnr_of_the_chair_is_that_of_the_reference_rasteriser():
    values = [photo_psnr(view) for view in range(0, 200, 10)]
    assert np.mean(values) == pytest.approx(EXPECTED_MEAN, abs=0.1)
