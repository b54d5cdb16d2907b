"""`minimise_rotation`: of the 24 equivalent rotations of a splat, the one of least angle."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from builders import random_splats
from nanogs import io
from nanogs.io.rotations import minimise_rotation
from nanogs.splats import RenderMode
from strategies import splats


def covariances(quats, log_scales):
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    return np.einsum("nij,nj,nkj->nik", turns, np.exp(2.0 * log_scales.astype(float)), turns)


@given(model=splats(max_n=30, extras=False))
def test_the_covariance_does_not_change(model):
    quats, scales = minimise_rotation(model)
    before, after = covariances(model.unit_quats(), model.log_scales), covariances(quats, scales)
    largest = np.abs(before).max(axis=(1, 2), initial=0)[:, None, None]
    assert (np.abs(before - after) <= 1e-6 * largest).all()
    assert np.array_equal(np.sort(scales, axis=1), np.sort(model.log_scales, axis=1))
    assert np.allclose(np.linalg.norm(quats, axis=1), 1)


@given(model=splats(max_n=30, extras=False))
def test_no_equivalent_rotation_has_a_smaller_angle(model):
    quats, _ = minimise_rotation(model)
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]])
    others = [(turns * other).magnitude() for other in Rotation.create_group("O")]
    assert (turns.magnitude() <= np.min(others, axis=0) + 1e-6).all()
    assert (quats[:, 0] > 0.85).all()
    assert np.abs(quats[:, 1:]).max(initial=0) < 0.383


@given(model=splats(max_n=30, extras=False))
def test_no_equivalent_rotation_with_the_same_third_axis_has_a_smaller_angle(model):
    quats, scales = minimise_rotation(model, third_stays=True)
    before, after = covariances(model.unit_quats(), model.log_scales), covariances(quats, scales)
    largest = np.abs(before).max(axis=(1, 2), initial=0)[:, None, None]
    assert (np.abs(before - after) <= 1e-6 * largest).all()
    assert np.array_equal(scales[:, 2], model.log_scales[:, 2])
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]])
    stays = [o for o in Rotation.create_group("O") if abs(o.as_matrix()[2, 2]) > 0.5]
    assert len(stays) == 8
    others = [(turns * other).magnitude() for other in stays]
    assert (turns.magnitude() <= np.min(others, axis=0) + 1e-6).all()
    assert (quats[:, :1] >= np.abs(quats) - 1e-6).all()


@pytest.mark.parametrize("name", ["a.sog", "meta.json", "a.rad"])
def test_the_third_axis_of_flat_splats_stays_their_normal(tmp_path, name):
    model = replace(random_splats(300, degree=0), render_mode=RenderMode.SURFEL)
    model.means[:, 0] = np.arange(300)
    model.log_scales[:, 2] = -9
    io.save(model, tmp_path / name)
    again = io.load(tmp_path / name)
    again = again.take(np.argsort(again.means[:, 0]))
    assert again.render_mode is RenderMode.SURFEL
    assert again.log_scales[:, 2] == pytest.approx(model.log_scales[:, 2], abs=0.15)
    normals = [
        Rotation.from_quat(each.unit_quats()[:, [1, 2, 3, 0]]).as_matrix()[:, :, 2]
        for each in (model, again)
    ]
    assert np.abs((normals[0] * normals[1]).sum(axis=1)).min() > 0.99


@pytest.mark.parametrize("suffix", [".rad", ".sog"])
def test_files_keep_the_third_axis_of_surfels(tmp_path, suffix):
    """It is their normal; rotations of other models may be written with the axes in any order."""
    model = replace(random_splats(300), render_mode=RenderMode.SURFEL)
    io.save(model, tmp_path / f"a{suffix}")
    found = io.load(tmp_path / f"a{suffix}")
    assert found.render_mode is RenderMode.SURFEL
    _, rows = cKDTree(found.means).query(model.means)
    normals = [
        Rotation.from_quat(each.quats[:, [1, 2, 3, 0]]).as_matrix()[:, :, 2]
        for each in (model, found.take(rows))
    ]
    assert (np.abs((normals[0] * normals[1]).sum(axis=1)) > 0.99).all()
