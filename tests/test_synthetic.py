import numpy as np
import pytest

from nanogs.datasets.synthetic import make_scene
from nanogs.errors import OptionError
from nanogs.sh import basis, lobe

COLUMNS = ("means", "log_scales", "quats", "opacity_logits", "sh")


def directions(n: int) -> np.ndarray:
    vectors = np.random.default_rng(0).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("count", [1, 2, 3, 11, 12, 13, 100, 999, 20_000])
def test_count_is_exact_and_values_finite(count):
    scene = make_scene(count)
    assert len(scene) == count
    assert scene.finite().all()
    assert np.isfinite(scene.opacity_logits).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_degree_is_as_requested(degree):
    assert make_scene(50, sh_degree=degree).sh_degree == degree


def test_same_seed_same_bytes():
    first, second = make_scene(5_000, seed=7), make_scene(5_000, seed=7)
    for name in COLUMNS:
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert make_scene(5_000, seed=8).means.tobytes() != first.means.tobytes()


def test_distribution_resembles_a_trained_model():
    scene = make_scene(50_000)
    alphas, scales = scene.opacities(), scene.scales()
    assert np.allclose(np.linalg.norm(scene.quats, axis=1), 1, atol=1e-5)
    assert (alphas > 0.9).mean() > 0.4
    assert 0.05 < (alphas < 0.1).mean() < 0.3
    assert scales.max() / np.median(scales) > 100, "sky and detail differ in size"
    assert np.median(scales.min(axis=1) / scales.max(axis=1)) < 0.1, "splats lie flat"
    elongation = np.sort(scales, axis=1)
    assert (elongation[:, 2] > 5 * elongation[:, 1]).mean() > 0.02, "there are no needles"


def test_ground_lies_below_and_sky_above_in_y_down():
    scene = make_scene(20_000)
    far = np.linalg.norm(scene.means, axis=1) > 25
    assert np.median(scene.means[far, 1]) < -5
    assert np.median(scene.means[~far, 1]) < 0
    assert np.mean(np.abs(scene.means[:, 1]) < 0.05) > 0.2, "the floor is at y = 0"


def test_colour_depends_on_the_view_and_stays_in_range():
    scene = make_scene(20_000)
    views = basis(directions(64), 3)
    colours = 0.5 + np.einsum("vk,nkc->nvc", views, scene.sh)
    assert colours.min() > -0.6
    assert colours.max() < 3
    assert np.median(np.ptp(colours, axis=1)) > 0.05


def test_bad_arguments_are_refused():
    for name, value, words in (
        ("count", 0, "has 1 to 2,147,483,647 splats"),
        ("count", 2**31, "has 1 to 2,147,483,647 splats"),
        ("sh_degree", 5, "SH degree"),
        ("sh_degree", -1, "SH degree"),
        ("seed", -1, "seed"),
        ("count", 10.5, "has 1 to 2,147,483,647 splats"),
        ("sh_degree", "1", "SH degree"),
        ("seed", None, "seed must be a whole number"),
    ):
        with pytest.raises(OptionError, match=f"{words}.*, not {value!r}"):
            make_scene(**{"count": 10, name: value})


def test_basis_is_orthonormal_and_matches_the_reference_constants():
    cosines, weights = np.polynomial.legendre.leggauss(12)
    angles = np.arange(24) * 2 * np.pi / 24
    ring = np.sqrt(1 - cosines[:, None] ** 2) * np.exp(1j * angles)
    sphere = np.stack(
        [ring.real, ring.imag, np.broadcast_to(cosines[:, None], ring.shape)], axis=-1
    ).reshape(-1, 3)
    values = basis(sphere, 4)
    gram = (values * np.repeat(weights, 24)[:, None] * 2 * np.pi / 24).T @ values
    assert np.allclose(gram, np.eye(25), atol=1e-12)
    x, y, z = sphere.T
    assert np.allclose(values[:, 0], 0.28209479177387814)
    assert np.allclose(values[:, 1], -0.4886025119029199 * y)
    assert np.allclose(values[:, 2], 0.4886025119029199 * z)
    assert np.allclose(values[:, 3], -0.4886025119029199 * x)
    assert np.allclose(values[:, 4], 1.0925484305920792 * x * y)
    assert np.allclose(values[:, 7], -1.0925484305920792 * x * z)
    assert np.allclose(values[:, 15], -0.5900435899266435 * x * (x * x - 3 * y * y))


def test_highlight_is_brightest_seen_from_its_axis():
    axis = directions(5)
    eyes = directions(500)
    brightness = basis(-eyes, 3) @ lobe(axis, 3, 0.16).T
    at_axis = (basis(-axis, 3) * lobe(axis, 3, 0.16)).sum(axis=1)
    assert np.allclose(at_axis, 1)
    assert (brightness <= 1 + 1e-12).all()
    assert (np.abs(brightness[eyes @ axis.T < 0.2]) < 0.35).all()
