"""Conversions between stored and rendered values."""

import numpy as np
from scipy.spatial.transform import Rotation

from nanogs.activations import quaternions, rotations


def test_rotations_become_quaternions_whatever_their_largest_component():
    rng = np.random.default_rng(0)
    quats = np.concatenate([rng.normal(size=(500, 4)), np.eye(4), np.full((1, 4), 0.5)])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    found = quaternions(expected)
    assert np.allclose(np.abs((found * quats).sum(axis=1)), 1, atol=1e-14)
    assert np.allclose(rotations(found), expected, atol=1e-14)
    assert quaternions(np.empty((0, 3, 3))).shape == (0, 4)
