"""The half turn between y up and y down."""

import dataclasses

import numpy as np
import pytest

from builders import random_splats
from nanogs.frames import half_turn
from nanogs.render.rasterize import render
from nanogs.render.views import automatic_cameras

TURN = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize("degree", range(5))
def test_a_turned_model_looks_the_same_from_a_turned_camera(degree):
    splats = random_splats(60, degree=degree, seed=degree)
    for camera in automatic_cameras(splats, 3, width=48, height=40):
        turned = dataclasses.replace(camera, world_to_camera=camera.world_to_camera @ TURN)
        expected, found = render(splats, camera).color, render(half_turn(splats), turned).color
        assert expected.max() > 0.1
        assert np.abs(found - expected).max() < 1e-4
        assert np.abs(render(splats, turned).color - expected).max() > 0.05


def test_two_half_turns_change_nothing():
    splats = random_splats(20, degree=3)
    again = half_turn(half_turn(splats))
    for name in ("means", "quats", "sh", "log_scales", "opacity_logits"):
        assert np.array_equal(getattr(again, name), getattr(splats, name))
    assert not np.array_equal(half_turn(splats).means, splats.means)
