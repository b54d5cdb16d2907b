"""`minimise_rotation`: of the 24 equivalent rotations of a splat, the one of least angle."""

import numpy as np
from hypothesis import given
from scipy.spatial.transform import Rotation

from nanogs.io.rotations import minimise_rotation
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
