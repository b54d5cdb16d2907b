"""Coverage and blocked light of splats from near and far, and the distances of viewers."""

from dataclasses import replace
from decimal import Decimal, localcontext

import numba
import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import exp1

import nanogs
import reference_kernels as reference
from builders import random_splats, same_pixel
from nanogs.datasets.synthetic import make_scene
from nanogs.method.growth import area_needs, blocked, effective_counts, widened
from nanogs.method.integrals import exponential_integral
from nanogs.method.nodes import NEARER, activate_nodes, footprints, gather
from nanogs.method.store import store_groups
from nanogs.method.viewers import (
    ANCHORS,
    APART,
    FARTHEST,
    NEAR,
    Dilation,
    Viewers,
    estimate_dilation,
    viewers_at,
)
from nanogs.metrics import psnr
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare, render
from nanogs.splats import RenderMode, Splats, concatenate
from nanogs.views.automatic import automatic_cameras

# Footprints


def rms_area(sigma, directions):
    """Mean of 2 pi √det on planes across all directions: det there is |Sigma| nᵀ Sigma⁻¹ n."""
    squares = np.einsum("ni,ij,nj->n", directions, np.linalg.inv(sigma), directions)
    return 2 * np.pi * np.sqrt(np.linalg.det(sigma) * np.mean(squares))


@pytest.mark.parametrize("pixel", [0.0, 0.05, 1.0])
def test_footprints_are_the_rms_area_over_directions_at_two_distances(pixel):
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rng = np.random.default_rng(1)
    sigmas = [reference.covariance(np.exp(rng.uniform(-3, 0, 3)), q) for q in
              np.linalg.qr(rng.normal(size=(4, 4)))[0]]  # fmt: skip
    found = footprints(np.array([reference.pack(sigma) for sigma in sigmas]), pixel)
    for sigma, area in zip(sigmas, found, strict=True):
        far, near = (sigma + p**2 * np.eye(3) for p in (pixel, pixel / NEARER))
        expected = (rms_area(far, directions) + rms_area(near, directions)) / 2
        assert area == pytest.approx(expected, rel=0.02)


def test_footprints_of_a_sphere_and_of_a_point():
    six = np.array([[4.0, 0, 0, 4, 0, 4], [0.0, 0, 0, 0, 0, 0]])
    assert footprints(six, 0.0) == pytest.approx([8 * np.pi, 0], abs=1e-6)
    # Variances of 16 and, for views four times as near, 1 are added.
    assert footprints(six, 4.0) == pytest.approx([(20 + 5) * np.pi, (16 + 1) * np.pi])
    assert footprints(six, np.array([0.0, 4.0])) == pytest.approx([8 * np.pi, 17 * np.pi])


# Surroundings


def ball(count, radius, seed=3):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return radius * means * np.cbrt(rng.uniform(size=(count, 1)))


def test_the_pixel_size_is_that_of_a_view_of_the_surroundings_of_a_splat():
    means = ball(4000, 7.0)
    means[0] = 0
    sizes = estimate_dilation(means, np.ones(4000), RenderMode.DEFAULT, 512)
    radius = 7 * np.cbrt(0.25)
    assert sizes.radii[0] == pytest.approx(radius, rel=0.03)
    assert sizes.at(means[:1])[0] == pytest.approx(np.sqrt(0.3) * 2 * radius / 512, rel=0.03)
    assert len(sizes.radii) <= ANCHORS
    assert sizes.least == pytest.approx(np.sqrt(0.3) * 2 * sizes.radii.min() / 512)


def test_mip_models_have_no_dilation():
    sizes = estimate_dilation(ball(100, 1.0), np.ones(100), RenderMode.MIP, 512)
    assert sizes.at(ball(5, 1.0)).tolist() == [0] * 5
    assert sizes.least == 0


def test_the_least_dilation_leaves_out_places_that_hold_much_of_the_model():
    assert Dilation(np.zeros((3, 3)), np.array([0.0, 3.0, 2.0]), 0.5).least == 1
    assert Dilation(np.zeros((2, 3)), np.zeros(2), 0.5).least == 0


def test_pixel_sizes_equal_the_reference_for_any_number_of_threads():
    rng = np.random.default_rng(0)
    points, anchors, radii = (
        rng.normal(size=(9000, 3)),
        rng.normal(size=(20, 3)),
        rng.uniform(size=20),
    )
    sizes = Dilation(anchors, radii, 0.5)
    points[:100] *= 1000
    squares = ((points[:, None] - anchors) ** 2).sum(axis=2) + radii**2
    expected = np.minimum(np.sqrt(squares.min(axis=1)), FARTHEST * np.median(radii))
    assert np.allclose(sizes.at(points), 0.5 * expected, rtol=1e-12)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        single_threaded = sizes.at(points)
    finally:
        numba.set_num_threads(threads)
    assert single_threaded.tobytes() == sizes.at(points).tobytes()


def test_nearness_falls_with_the_squared_distance_beyond_the_scene():
    """Up to 2.5 radii it is 1; from there it falls as the size of a splat in the picture does."""
    means = ball(5000, 3.0)
    sizes = estimate_dilation(means, np.ones(len(means)), RenderMode.DEFAULT, 512.0)
    near = NEAR * np.quantile(sizes.radii, 0.1)
    distances = np.array([0.0, 0.5 * near, near, 2 * near, 1e6 * near])
    assert sizes.nearness_at(distances) == pytest.approx([1, 1, 1, 1 / 4, 1e-12])
    assert (sizes.nearness(means) == 1).all()
    mip = estimate_dilation(means, np.ones(len(means)), RenderMode.MIP, 512.0)
    assert (mip.nearness_at(distances) == sizes.nearness_at(distances)).all()


def test_nearness_is_one_everywhere_for_a_scene_at_one_point():
    sizes = estimate_dilation(np.zeros((9, 3)), np.ones(9), RenderMode.DEFAULT, 512.0)
    assert (sizes.nearness_at(np.array([0.0, 5.0])) == 1).all()


def under_a_sky(count):
    """Return a scene, the same below a sky of an equal share of pictures, and a radius between.

    In scene units the area of the sky is ten thousand times as large.
    """
    front, sky = make_scene(3 * count, sh_degree=0), make_scene(count, sh_degree=0, seed=1)
    radius = np.abs(front.means).max()
    directions = sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    sky = replace(
        sky, means=(100 * radius * directions).astype(np.float32),
        log_scales=sky.log_scales + np.float32(np.log(100)),
    )  # fmt: skip
    return front, concatenate([front, sky]), 10 * radius


def kept_within(radius, scene, folder, **options):
    """Simplify to a tenth and return the share of splats within the radius, before the sky."""
    nanogs.save(scene, folder / "in.ply", overwrite=True)
    out = folder / "out.ply"
    nanogs.simplify_blocks(folder / "in.ply", out, ratio=0.1, overwrite=True, **options)
    small = nanogs.load(out)
    return np.mean(np.linalg.norm(small.means, axis=1) < radius)


@pytest.mark.parametrize("options", [{"preset": "fast"}, {"block": 2500, "preset": "fast"}])
def test_a_sky_does_not_take_most_splats_from_the_scene_before_it(tmp_path, options):
    _, scene, radius = under_a_sky(2000)
    assert kept_within(radius, scene, tmp_path, **options) > 0.5


@pytest.mark.parametrize(
    "view_options", [{"up": (0, -1, 0)}, {"cameras": "orbit"}, {"cameras": "roam"}]
)
def test_automatic_cameras_are_not_taken_for_positions_of_viewers(tmp_path, view_options):
    """Hidden splats get a full weight, so that the forest depends on views in no other way."""
    _, scene, _ = under_a_sky(500)
    nanogs.save(scene, tmp_path / "in.ply")
    options = {"ratio": 0.1, "hidden": 1, "steps": 0, "views": 6, "view_size": 64}
    default, changed = (
        nanogs.simplify_blocks(tmp_path / "in.ply", tmp_path / f"{name}.ply", **options, **more)
        for name, more in enumerate([{}, view_options])
    )
    forests = [
        [(each.candidates, each.merged) for each in report.passes] for report in (default, changed)
    ]
    assert forests[0] == forests[1]


@pytest.mark.parametrize("blocks", [{}, {"block": 4000}])
def test_the_users_cameras_count_as_viewers_even_without_measuring(tmp_path, blocks):
    front, scene, radius = under_a_sky(1000)
    front_elsewhere = replace(front, means=front.means + np.float32([5 * radius, 0, 0]))
    cameras = automatic_cameras(front_elsewhere, 6, width=64, height=64)
    options = {"guided": False, "steps": 2, "further": 0, "view_size": 64}
    kept = kept_within(radius, scene, tmp_path, cameras=cameras, **options, **blocks)
    assert kept < 0.5


def test_nearness_to_viewers_equals_the_reference_for_any_number_of_threads():
    rng = np.random.default_rng(0)
    points, positions = rng.normal(size=(9000, 3)), rng.normal(size=(20, 3))
    points[:100] *= 1000
    squares = ((points[:, None] - positions) ** 2).sum(axis=2)
    found = Viewers(positions, 0.5).nearness(points)
    assert np.allclose(found, (1 / (1 + squares / 0.25)).mean(axis=1), rtol=1e-12)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        single_threaded = Viewers(positions, 0.5).nearness(points)
    finally:
        numba.set_num_threads(threads)
    assert single_threaded.tobytes() == found.tobytes()
    assert viewers_at(positions, points).apart == pytest.approx(
        APART * np.quantile(np.sqrt(squares.min(axis=1)), 0.25), rel=0.1
    )
    coincident = viewers_at(np.zeros((2, 3)), np.zeros((9, 3)))
    assert coincident.apart == 0
    assert (coincident.nearness(points) == 1).all()


@pytest.mark.parametrize("blocks", [{}, {"block": 1500}])
def test_most_splats_are_kept_near_the_users_cameras(tmp_path, blocks):
    """Two equal scenes: the cameras are beside the first and see the second far behind it."""
    scene = make_scene(1500, sh_degree=0)
    far = 40 * np.float32(np.abs(scene.means).max())
    nanogs.save(
        concatenate([scene, replace(scene, means=scene.means + [far, 0, 0])]), tmp_path / "in.ply"
    )
    cameras = automatic_cameras(scene, 12, width=64, height=64)
    nanogs.simplify_blocks(
        tmp_path / "in.ply", tmp_path / "out.ply", ratio=0.1, cameras=cameras, steps=0, **blocks
    )
    small = nanogs.load(tmp_path / "out.ply")
    assert np.count_nonzero(small.means[:, 0] < far / 2) > 0.8 * len(small)


def test_far_copies_of_a_scene_hardly_change_its_pixel_sizes():
    means, alphas = ball(4000, 1.0), np.ones(4000)
    without_copies = estimate_dilation(means, alphas, RenderMode.DEFAULT, 512).at(means)
    for copies in (2, 3):
        copied = np.concatenate([means + [1e6 * c, 0, 0] for c in range(copies)])
        found = estimate_dilation(copied, np.tile(alphas, copies), RenderMode.DEFAULT, 512).at(
            means
        )
        assert (found / without_copies).max() < 2


def test_surroundings_are_weighted_by_alpha_unless_all_alphas_are_zero():
    means = np.array([[0.0, 0, 0]] * 50 + [[1.0, 0, 0]] * 50)
    one_side = estimate_dilation(means, np.r_[np.zeros(50), np.ones(50)], RenderMode.DEFAULT, 512)
    assert one_side.radii.tolist() == [1.0] * 25 + [0.0] * 25
    assert (
        estimate_dilation(means, np.zeros(100), RenderMode.DEFAULT, 512).radii.tolist()
        == [0.0] * 50
    )
    assert estimate_dilation(means[:1], np.ones(1), RenderMode.DEFAULT, 512).at(means[:1])[0] == 0


# Light


@pytest.mark.parametrize("layers", [0.0, 1e-9, 1e-5, 0.3, 1.0, 5.0, 300.0])
@pytest.mark.parametrize("count", [1.0, 1.3, 2.0, 5.7, 11.9, 12.0, 40.0, np.inf])
def test_blocked_light_equals_the_integral_over_the_plane(layers, count):
    """Integrate over the radius r of a Gaussian exp(-r²/2), the footprint of which is 2 pi."""
    r = np.linspace(0, 12, 200_001)
    g, n = np.exp(-(r**2) / 2), max(count, layers)
    with np.errstate(divide="ignore"):  # all light is blocked in the middle
        light = -np.expm1(n * np.log1p(-layers / n * g) if n < np.inf else -layers * g)
    expected = trapezoid(light * 2 * np.pi * r, r)
    found = blocked(np.array([layers * 2 * np.pi]), np.array([2 * np.pi]), np.array([count]))
    exact = count == np.inf or (count < 12 and count == round(count) and layers <= count)
    assert found[0] == pytest.approx(expected, rel=1e-6 if exact else 4e-4, abs=1e-12)


def test_a_group_of_one_blocks_what_its_member_covers():
    coverages, areas = np.array([0.0, 1e-300, 0.1, 3.0]), np.array([1.0, 1.0, 4.0, 3.0])
    assert blocked(coverages, areas, np.ones(4)) == pytest.approx(coverages, rel=1e-14)


def test_effective_counts_are_those_of_members_of_equal_coverage():
    leaves = activate_nodes(random_splats(9), np.arange(9), np.zeros(3), same_pixel(0.0))
    leaves = replace(leaves, coverages=np.array([2.0, 2, 2, 5, 1e-9, 0, 0, 3, 1]))
    labels = np.array([0, 0, 0, 1, 1, 2, 2, 3, 3], np.int32)
    found = effective_counts(leaves, labels, np.bincount(labels, leaves.coverages))
    assert found == pytest.approx([3, 1, 1, 16 / 10])


def test_effective_counts_of_merged_groups_are_those_of_all_members():
    leaves = activate_nodes(random_splats(9), np.arange(9), np.zeros(3), same_pixel(0.0))
    labels, together = np.array([0, 0, 0, 1, 1, 2, 2, 3, 3], np.int32), np.zeros(9, np.int32)
    merged = gather(leaves, labels, 4)
    counts = effective_counts(leaves, labels, merged.coverages)
    whole = merged.coverages.sum(keepdims=True)
    again = effective_counts(merged, together[:4], whole, counts)
    assert again == pytest.approx(effective_counts(leaves, together, whole))


@pytest.mark.parametrize("preset", ["fast", "default"])
def test_an_opaque_splat_stays_opaque_when_an_invisible_one_joins_it(preset):
    splats = random_splats(1).take(np.zeros(2, np.int64))
    splats.opacity_logits[:] = 6, -6
    small, _ = nanogs.simplify(splats, count=1, preset=preset)
    assert small.opacities()[0] == pytest.approx(splats.opacities()[0], abs=1e-3)


def test_the_integral_is_exact_to_a_few_units_in_the_last_place():
    """Compared with its alternating series in sufficiently many digits."""
    rng = np.random.default_rng(0)
    u = np.concatenate([10 ** rng.uniform(-12, 1.6, 60), rng.uniform(3.9, 4.1, 60), [4.0]])
    expected = [integral_of(Decimal(value)) for value in u.tolist()]
    found = exponential_integral(u)
    errors = [float(abs(Decimal(f) / e - 1)) for f, e in zip(found.tolist(), expected, strict=True)]
    assert max(errors) < 6e-16
    assert np.allclose(found[u > 0.1], (exp1(u) + np.log(u) + np.euler_gamma)[u > 0.1], rtol=1e-14)


def integral_of(u: Decimal) -> Decimal:
    """Return the sum of -(-u)^k / (k k!) for k from 1."""
    with localcontext(prec=80):
        term = total = u
        for k in range(2, 300):
            term *= -u / k
            total += term / k
        return +total


def test_the_integral_is_right_at_zero_infinity_and_nan():
    u = np.array([0.0, 5e-324, 1e-300, 1e300, np.inf])
    assert exponential_integral(u).tolist() == [
        0.0,
        5e-324,
        1e-300,
        np.log(1e300) + np.euler_gamma,
        np.inf,
    ]
    assert np.isnan(exponential_integral(np.array([np.nan]))).all()


def test_coincident_spheres_become_one_that_blocks_as_much_light():
    """Ten of alpha 0.05 and deviation 2 at any distance: (1 - 0.05 g)^10 passes, and that once."""
    splats = random_splats(1).take(np.zeros(10, np.int64))
    splats.means[:] = 0
    splats.log_scales[:] = np.log(2)
    splats.opacity_logits[:] = np.log(0.05 / 0.95)
    for pixel in (0.0, 3.0):
        leaves = activate_nodes(splats, np.arange(10), np.zeros(3), same_pixel(pixel))
        labels = np.zeros(10, np.int32)
        groups = store_groups(leaves, labels, splats, np.zeros(3), same_pixel(pixel))
        merged = groups.grown(1.0)
        assert merged.scales()[0] == pytest.approx([2, 2, 2], rel=1e-4)
        alpha = sum((1 - 0.95**k) / k for k in range(1, 11))
        assert merged.opacities()[0] == pytest.approx(alpha, rel=1e-5)


def test_coverage_is_conserved_between_a_near_and_a_far_view():
    """Needles far apart do not hide each other; one faint splat has their mean coverage of both."""
    count, pixel = 20, 0.2
    rng = np.random.default_rng(0)
    splats = random_splats(1).take(np.zeros(count, np.int64))
    splats.means[:] = rng.normal(0, 10, (count, 3))
    splats.log_scales[:] = np.log([1.0, 0.01, 0.01])
    splats.quats[:] = rng.normal(size=(count, 4))
    splats.opacity_logits[:] = 0
    leaves = activate_nodes(splats, np.arange(count), np.zeros(3), same_pixel(pixel))
    labels = np.zeros(count, np.int32)
    groups = store_groups(leaves, labels, splats, np.zeros(3), same_pixel(pixel))
    small = groups.grown(1.0)
    merged = gather(leaves, labels, 1)

    def covered(covariances, alphas, pixel):
        xx, xy, xz, yy, yz, zz = covariances.T
        xx, yy, zz = xx + pixel**2, yy + pixel**2, zz + pixel**2
        minors = xx * yy - xy**2 + xx * zz - xz**2 + yy * zz - yz**2
        return (alphas * 2 * np.pi * np.sqrt(minors / 3)).sum()

    near, far = (
        covered(merged.covariances, small.opacities(), p) / covered(leaves.covariances, 0.5, p)
        for p in (pixel / NEARER, pixel)
    )
    assert near > 1 > far
    sums = [covered(leaves.covariances, 0.5, p) for p in (pixel / NEARER, pixel)]
    assert np.dot([near, far], sums) == pytest.approx(sum(sums), rel=0.01)


def test_all_axes_but_the_thinnest_grow_to_the_blocked_area():
    """For opaque coincident splats, u of 20 layers asks for an area of Ein(20) = 3.57 times."""
    splats = random_splats(1).take(np.zeros(20, np.int64))
    splats.log_scales[:] = np.log([2, 0.1, 1])
    splats.quats[:] = [1, 0, 0, 0]
    splats.opacity_logits[:] = 40
    leaves = activate_nodes(splats, np.arange(20), np.zeros(3), same_pixel(0.0))
    labels = np.zeros(20, np.int32)
    merged = gather(leaves, labels, 1)
    areas = footprints(merged.covariances, 0.0)
    needed, least_area = area_needs(merged, leaves, labels, areas, sheets=False)
    assert needed == pytest.approx([3.5731], rel=1e-4)
    assert least_area == [1.0]
    scales = np.float32([[2, 0.1, 1], [1, 1, 1]])
    grown = widened(scales, np.array([4.0, 1.0]))
    assert grown == pytest.approx(np.array([[4, 0.1, 2], [1, 1, 1]]))
    groups = store_groups(leaves, labels, splats, np.zeros(3), same_pixel(0.0))
    for growth, factor in ((3.0, 3.5731), (1.25, 1.25**2), (1.0, 1.0)):
        lengths = np.exp(groups.grown(growth).log_scales[0])
        assert np.sort(lengths) == pytest.approx([0.1, factor**0.5, 2 * factor**0.5], rel=1e-4)


@pytest.mark.parametrize("logit", [-np.inf, -45.0, -42.0])
def test_transparent_members_do_not_reduce_the_growth_of_a_group(logit):
    splats = random_splats(1).take(np.zeros(25, np.int64))
    splats.log_scales[:] = np.log([2, 0.1, 1])
    splats.opacity_logits[:20], splats.opacity_logits[20:] = 40, logit
    leaves = activate_nodes(splats, np.arange(25), np.zeros(3), same_pixel(0.0))
    labels = np.r_[np.zeros(21), np.ones(4)].astype(np.int32)  # the last four are a group
    merged = gather(leaves, labels, 2)
    areas = footprints(merged.covariances, 0.0)
    needed, _ = area_needs(merged, leaves, labels, areas, sheets=False)
    assert needed[0] == pytest.approx(3.5731, rel=1e-4)
    assert needed[1] == pytest.approx(merged.coverages[1] / areas[1], abs=1e-15)


# Scenes


def pictures_of(model, cameras):
    prepared = prepare(model)
    return [render(prepared, camera).shown() for camera in cameras]


def quality(original, small, cameras):
    shown = zip(pictures_of(original, cameras), pictures_of(small, cameras), strict=True)
    return np.mean([psnr(first, second) for first, second in shown])


@pytest.mark.parametrize("options", [{"preset": "fast"}, {"steps": 0}])
def test_a_far_copy_of_a_scene_hardly_changes_its_result(options):
    """Only merging is compared: views of both show neither, and a fit to them gains nothing.

    Which of the two such views favour is chance, so it is the mean over several scenes that counts.
    """
    losses = []
    for seed in range(5):
        splats = make_scene(6000, sh_degree=0, seed=seed)
        copy = splats.take(np.arange(6000))
        copy.means[:, 0] += 1e5
        cameras = automatic_cameras(splats, 4, width=256, height=256, split="test")
        scene_and_copy = concatenate([splats, copy])
        small, _ = nanogs.simplify(splats, ratio=0.1, **options)
        small_with_copy, _ = nanogs.simplify(scene_and_copy, ratio=0.1, **options)
        losses.append(quality(splats, small, cameras) - quality(splats, small_with_copy, cameras))
    assert np.mean(losses) < 1


def needles(seed, count=3000):
    """Return needles in a ball that are thinner than a pixel and too few to hide each other."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=ball(count, 1.0).astype(np.float32),
        log_scales=np.log(np.tile(np.float32([0.05, 2e-4, 2e-4]), (count, 1))),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=np.ones((count, 1, 3), np.float32),
    )


def camera_at_distance_four(focal, size=512):
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return Camera(size, size, focal, focal, size / 2, size / 2, pose, near=0.01)


@pytest.mark.parametrize(("pixels", "in_range"), [(512.0, True), (4096.0, False), (64.0, False)])
def test_needles_keep_their_mean_brightness_over_a_range_of_distances(pixels, in_range):
    """From far they are too faint and from four times as near too bright, each by less than a
    factor of two, and the sum is right. Summed over eight hedges, because single ones vary."""
    before, after = np.zeros((2, 2))
    for splats in map(needles, range(8)):
        pixel_sizes = estimate_dilation(
            splats.means.astype(float), splats.opacities(), RenderMode.DEFAULT, 512
        )
        focal = 4.0 * np.sqrt(0.3) / np.median(pixel_sizes.at(splats.means.astype(float)))
        small, _ = nanogs.simplify(splats, ratio=0.1, preset="fast", pixels=pixels)
        cameras = [camera_at_distance_four(focal), camera_at_distance_four(focal * NEARER)]
        before += [view.mean() for view in pictures_of(splats, cameras)]
        after += [view.mean() for view in pictures_of(small, cameras)]
    far, near = after / before
    assert (
        0.5 < far < 1 < near < 2 and sum(after) == pytest.approx(sum(before), rel=0.1)
    ) == in_range
