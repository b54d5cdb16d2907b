"""Coverage and blocking of splats from near and from far, and how far away that is."""

from dataclasses import replace
from decimal import Decimal, localcontext

import numba
import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import exp1

import nanogs
import twins
from builders import random_splats, same_pixel
from nanogs.datasets.synthetic import make_scene
from nanogs.method.extent import (
    ANCHORS,
    APART,
    FARTHEST,
    NEAR,
    Dilation,
    Viewers,
    dilation,
    viewers,
)
from nanogs.method.growth import area_needs, blocked, widened
from nanogs.method.integrals import exponential_integral
from nanogs.method.nodes import NEARER, activate_nodes, footprints, gather
from nanogs.method.store import store_groups
from nanogs.metrics import psnr
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare, render
from nanogs.splats import RenderMode, Splats, concatenate
from nanogs.views.automatic import automatic_cameras

# Footprints


def rms_area(sigma, directions):
    """2 pi √det on planes across all directions: det there is |Sigma| nᵀ Sigma⁻¹ n."""
    squares = np.einsum("ni,ij,nj->n", directions, np.linalg.inv(sigma), directions)
    return 2 * np.pi * np.sqrt(np.linalg.det(sigma) * np.mean(squares))


@pytest.mark.parametrize("pixel", [0.0, 0.05, 1.0])
def test_footprints_are_the_rms_area_over_directions_at_two_distances(pixel):
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rng = np.random.default_rng(1)
    sigmas = [twins.covariance(np.exp(rng.uniform(-3, 0, 3)), q) for q in
              np.linalg.qr(rng.normal(size=(4, 4)))[0]]  # fmt: skip
    found = footprints(np.array([twins.pack(sigma) for sigma in sigmas]), pixel)
    for sigma, area in zip(sigmas, found, strict=True):
        far, near = (sigma + p**2 * np.eye(3) for p in (pixel, pixel / NEARER))
        expected = (rms_area(far, directions) + rms_area(near, directions)) / 2
        assert area == pytest.approx(expected, rel=0.02)


def test_footprints_of_a_sphere_and_of_a_point():
    six = np.array([[4.0, 0, 0, 4, 0, 4], [0.0, 0, 0, 0, 0, 0]])
    assert footprints(six, 0.0) == pytest.approx([8 * np.pi, 0], abs=1e-6)
    # Variances of 16 and, from four times as near, 1 are added.
    assert footprints(six, 4.0) == pytest.approx([(20 + 5) * np.pi, (16 + 1) * np.pi])
    assert footprints(six, np.array([0.0, 4.0])) == pytest.approx([8 * np.pi, 17 * np.pi])


# Surroundings


def ball(count, radius, seed=3):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return radius * means * np.cbrt(rng.uniform(size=(count, 1)))


def test_a_pixel_is_that_of_a_view_of_what_surrounds_a_splat():
    means = ball(4000, 7.0)
    means[0] = 0
    found = dilation(means, np.ones(4000), RenderMode.DEFAULT, 512)
    radius = 7 * np.cbrt(0.25)
    assert found.radii[0] == pytest.approx(radius, rel=0.03)
    assert found.at(means[:1])[0] == pytest.approx(np.sqrt(0.3) * 2 * radius / 512, rel=0.03)
    assert len(found.radii) <= ANCHORS
    assert found.least == pytest.approx(np.sqrt(0.3) * 2 * found.radii.min() / 512)


def test_mip_models_have_no_dilation():
    found = dilation(ball(100, 1.0), np.ones(100), RenderMode.MIP, 512)
    assert found.at(ball(5, 1.0)).tolist() == [0] * 5
    assert found.least == 0


def test_the_surroundings_reach_as_the_twin_says_for_any_number_of_threads():
    rng = np.random.default_rng(0)
    points, anchors, radii = (
        rng.normal(size=(9000, 3)),
        rng.normal(size=(20, 3)),
        rng.uniform(size=20),
    )
    around = Dilation(anchors, radii, 0.5)
    points[:100] *= 1000
    squares = ((points[:, None] - anchors) ** 2).sum(axis=2) + radii**2
    expected = np.minimum(np.sqrt(squares.min(axis=1)), FARTHEST * np.median(radii))
    assert np.allclose(around.at(points), 0.5 * expected, rtol=1e-12)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        alone = around.at(points)
    finally:
        numba.set_num_threads(threads)
    assert alone.tobytes() == around.at(points).tobytes()


def test_what_lies_beyond_the_scene_is_as_near_as_it_looks():
    """Up to 2.5 radii all is 1; from there it falls as the picture of a splat does."""
    means = ball(5000, 3.0)
    found = dilation(means, np.ones(len(means)), RenderMode.DEFAULT, 512.0)
    near = NEAR * np.quantile(found.radii, 0.1)
    distances = np.array([0.0, 0.5 * near, near, 2 * near, 1e6 * near])
    assert found.nearness_at(distances) == pytest.approx([1, 1, 1, 1 / 4, 1e-12])
    assert (found.nearness(means) == 1).all()
    mip = dilation(means, np.ones(len(means)), RenderMode.MIP, 512.0)
    assert (mip.nearness_at(distances) == found.nearness_at(distances)).all()


def test_a_scene_at_one_place_has_nothing_beyond_it():
    found = dilation(np.zeros((9, 3)), np.ones(9), RenderMode.DEFAULT, 512.0)
    assert (found.nearness_at(np.array([0.0, 5.0])) == 1).all()


def under_a_sky(count):
    """A scene, the same below a sky that takes as large a share of pictures, and how far it is.

    In scene units the sky is ten thousand times as large.
    """
    front, sky = make_scene(3 * count, sh_degree=0), make_scene(count, sh_degree=0, seed=1)
    reach = np.abs(front.means).max()
    ways = sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    sky = replace(
        sky, means=(100 * reach * ways).astype(np.float32),
        log_scales=sky.log_scales + np.float32(np.log(100)),
    )  # fmt: skip
    return front, concatenate([front, sky]), 10 * reach


def kept_within(reach, scene, folder, **options):
    """Share of a tenth of the splats that is not of the sky."""
    nanogs.save(scene, folder / "in.ply", overwrite=True)
    out = folder / "out.ply"
    nanogs.simplify_blocks(folder / "in.ply", out, ratio=0.1, overwrite=True, **options)
    small = nanogs.load(out)
    return np.mean(np.linalg.norm(small.means, axis=1) < reach)


@pytest.mark.parametrize("options", [{"preset": "fast"}, {"block": 2500, "preset": "fast"}])
def test_sky_does_not_take_the_splats_of_what_stands_before_it(tmp_path, options):
    _, scene, reach = under_a_sky(2000)
    assert kept_within(reach, scene, tmp_path, **options) > 0.5


@pytest.mark.parametrize("given", [{"up": (0, -1, 0)}, {"cameras": "orbit"}, {"cameras": "roam"}])
def test_cameras_that_are_found_tell_nothing_of_viewers(tmp_path, given):
    """All splats count as visible ones, so that nothing else of the views is in the forest."""
    _, scene, _ = under_a_sky(500)
    nanogs.save(scene, tmp_path / "in.ply")
    options = {"ratio": 0.1, "hidden": 1, "steps": 0, "views": 6, "view_size": 64}
    usual, chosen = (
        nanogs.simplify_blocks(tmp_path / "in.ply", tmp_path / f"{place}.ply", **options, **some)
        for place, some in enumerate([{}, given])
    )
    forests = [[(one.candidates, one.merged) for one in each.passes] for each in (usual, chosen)]
    assert forests[0] == forests[1]


@pytest.mark.parametrize("blocks", [{}, {"block": 4000}])
def test_a_users_cameras_tell_where_results_are_not_measured_too(tmp_path, blocks):
    front, scene, reach = under_a_sky(1000)
    away = replace(front, means=front.means + np.float32([5 * reach, 0, 0]))
    cameras = automatic_cameras(away, 6, width=64, height=64)
    options = {"measure": False, "steps": 2, "further": 0, "view_size": 64}
    kept = kept_within(reach, scene, tmp_path, cameras=cameras, **options, **blocks)
    assert kept < 0.5


def test_viewers_see_as_the_twin_says_for_any_number_of_threads():
    rng = np.random.default_rng(0)
    points, places = rng.normal(size=(9000, 3)), rng.normal(size=(20, 3))
    points[:100] *= 1000
    squares = ((points[:, None] - places) ** 2).sum(axis=2)
    found = Viewers(places, 0.5).nearness(points)
    assert np.allclose(found, (1 / (1 + squares / 0.25)).mean(axis=1), rtol=1e-12)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        alone = Viewers(places, 0.5).nearness(points)
    finally:
        numba.set_num_threads(threads)
    assert alone.tobytes() == found.tobytes()
    assert viewers(places, points).apart == pytest.approx(
        APART * np.quantile(np.sqrt(squares.min(axis=1)), 0.25), rel=0.1
    )
    beside = viewers(np.zeros((2, 3)), np.zeros((9, 3)))
    assert beside.apart == 0
    assert (beside.nearness(points) == 1).all()


@pytest.mark.parametrize("blocks", [{}, {"block": 1500}])
def test_splats_go_where_cameras_stand(tmp_path, blocks):
    """Two scenes alike, of which the cameras are beside one and see the other far behind it."""
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


def test_copies_far_away_hardly_change_a_pixel():
    means, alphas = ball(4000, 1.0), np.ones(4000)
    alone = dilation(means, alphas, RenderMode.DEFAULT, 512).at(means)
    for copies in (2, 3):
        many = np.concatenate([means + [1e6 * c, 0, 0] for c in range(copies)])
        found = dilation(many, np.tile(alphas, copies), RenderMode.DEFAULT, 512).at(means)
        assert (found / alone).max() < 2


def test_surroundings_follow_alpha_and_stand_without_any():
    means = np.array([[0.0, 0, 0]] * 50 + [[1.0, 0, 0]] * 50)
    one_side = dilation(means, np.r_[np.zeros(50), np.ones(50)], RenderMode.DEFAULT, 512)
    assert one_side.radii.tolist() == [1.0] * 25 + [0.0] * 25
    assert dilation(means, np.zeros(100), RenderMode.DEFAULT, 512).radii.tolist() == [0.0] * 50
    assert dilation(means[:1], np.ones(1), RenderMode.DEFAULT, 512).at(means[:1])[0] == 0


# Light


@pytest.mark.parametrize("layers", [0.0, 1e-9, 1e-5, 0.3, 1.0, 5.0, 300.0])
def test_what_is_blocked_is_one_less_what_gets_through_everywhere(layers):
    """Over the plane, at radius r of a Gaussian g = exp(-r²/2) of footprint 2 pi."""
    r = np.linspace(0, 12, 200_001)
    light = -np.expm1(-layers * np.exp(-(r**2) / 2))
    expected = trapezoid(light * 2 * np.pi * r, r)
    found = blocked(np.array([layers * 2 * np.pi]), np.array([2 * np.pi]))
    assert found[0] == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_the_integral_is_exact_to_a_few_units_in_the_last_place():
    """Against its alternating series in as many digits as that takes."""
    rng = np.random.default_rng(0)
    u = np.concatenate([10 ** rng.uniform(-12, 1.6, 60), rng.uniform(3.9, 4.1, 60), [4.0]])
    expected = [integral_of(Decimal(value)) for value in u.tolist()]
    found = exponential_integral(u)
    errors = [float(abs(Decimal(f) / e - 1)) for f, e in zip(found.tolist(), expected, strict=True)]
    assert max(errors) < 6e-16
    assert np.allclose(found[u > 0.1], (exp1(u) + np.log(u) + np.euler_gamma)[u > 0.1], rtol=1e-14)


def integral_of(u: Decimal) -> Decimal:
    """The sum of -(-u)^k / (k k!), k from 1."""
    with localcontext(prec=80):
        term = total = u
        for k in range(2, 300):
            term *= -u / k
            total += term / k
        return +total


def test_the_integral_holds_at_its_ends():
    u = np.array([0.0, 5e-324, 1e-300, 1e300, np.inf])
    assert exponential_integral(u).tolist() == [
        0.0,
        5e-324,
        1e-300,
        np.log(1e300) + np.euler_gamma,
        np.inf,
    ]
    assert np.isnan(exponential_integral(np.array([np.nan]))).all()


def test_spheres_at_one_place_become_one_that_blocks_as_much():
    """Ten of alpha 0.05 and deviation 2: u = 0.5 at any distance, alpha 0.5 - 0.5²/4 + 0.5³/18."""
    splats = random_splats(1).take(np.zeros(10, np.int64))
    splats.means[:] = 0
    splats.log_scales[:] = np.log(2)
    splats.opacity_logits[:] = np.log(0.05 / 0.95)
    for pixel in (0.0, 3.0):
        leaves = activate_nodes(splats, np.arange(10), np.zeros(3), same_pixel(pixel))
        labels = np.zeros(10, np.int32)
        groups = store_groups(leaves, labels, splats, np.zeros(3), same_pixel(pixel))
        one = groups.grown(1.0)
        assert one.scales()[0] == pytest.approx([2, 2, 2], rel=1e-4)
        assert one.opacities()[0] == pytest.approx(0.44382, rel=2e-3)


def test_coverage_is_conserved_between_a_near_and_a_far_view():
    """Needles far apart hide nothing: one faint splat covers the mean of both distances."""
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
    one = groups.grown(1.0)
    merged = gather(leaves, labels, 1)

    def covered(covariances, alphas, pixel):
        xx, xy, xz, yy, yz, zz = covariances.T
        xx, yy, zz = xx + pixel**2, yy + pixel**2, zz + pixel**2
        minors = xx * yy - xy**2 + xx * zz - xz**2 + yy * zz - yz**2
        return (alphas * 2 * np.pi * np.sqrt(minors / 3)).sum()

    near, far = (
        covered(merged.covariances, one.opacities(), p) / covered(leaves.covariances, 0.5, p)
        for p in (pixel / NEARER, pixel)
    )
    assert near > 1 > far
    sums = [covered(leaves.covariances, 0.5, p) for p in (pixel / NEARER, pixel)]
    assert np.dot([near, far], sums) == pytest.approx(sum(sums), rel=0.01)


def test_axes_grow_to_what_is_blocked_but_for_the_thinnest():
    """Opaque ones at one place: u of 20 layers would grow to Ein(20) = 3.57 areas."""
    splats = random_splats(1).take(np.zeros(20, np.int64))
    splats.log_scales[:] = np.log([2, 0.1, 1])
    splats.quats[:] = [1, 0, 0, 0]
    splats.opacity_logits[:] = 40
    leaves = activate_nodes(splats, np.arange(20), np.zeros(3), same_pixel(0.0))
    labels = np.zeros(20, np.int32)
    merged = gather(leaves, labels, 1)
    areas = footprints(merged.covariances, 0.0)
    needed, least = area_needs(merged, leaves, labels, areas, sheets=False)
    assert needed == pytest.approx([3.5731], rel=1e-4)
    assert least == [1.0]
    scales = np.float32([[2, 0.1, 1], [1, 1, 1]])
    wider = widened(scales, np.array([4.0, 1.0]))
    assert wider == pytest.approx(np.array([[4, 0.1, 2], [1, 1, 1]]))
    groups = store_groups(leaves, labels, splats, np.zeros(3), same_pixel(0.0))
    for growth, factor in ((3.0, 3.5731), (1.25, 1.25**2), (1.0, 1.0)):
        lengths = np.exp(groups.grown(growth).log_scales[0])
        assert np.sort(lengths) == pytest.approx([0.1, factor**0.5, 2 * factor**0.5], rel=1e-4)


@pytest.mark.parametrize("logit", [-np.inf, -45.0, -42.0])
def test_members_that_cover_nothing_do_not_keep_the_others_from_growing(logit):
    splats = random_splats(1).take(np.zeros(25, np.int64))
    splats.log_scales[:] = np.log([2, 0.1, 1])
    splats.opacity_logits[:20], splats.opacity_logits[20:] = 40, logit
    leaves = activate_nodes(splats, np.arange(25), np.zeros(3), same_pixel(0.0))
    labels = np.r_[np.zeros(21), np.ones(4)].astype(np.int32)  # and four of these by themselves
    merged = gather(leaves, labels, 2)
    areas = footprints(merged.covariances, 0.0)
    needed, _ = area_needs(merged, leaves, labels, areas, sheets=False)
    assert needed[0] == pytest.approx(3.5731, rel=1e-4)
    assert needed[1] == pytest.approx(merged.coverages[1] / areas[1], abs=1e-15)


# Scenes


def over_black(model, cameras):
    prepared = prepare(model)
    return [render(prepared, camera).shown() for camera in cameras]


def quality(original, small, cameras):
    shown = zip(over_black(original, cameras), over_black(small, cameras), strict=True)
    return np.mean([psnr(first, second) for first, second in shown])


@pytest.mark.parametrize("options", [{"preset": "fast"}, {"steps": 0}])
def test_a_copy_far_away_leaves_a_scene_as_it_is_alone(options):
    """As it is merged: views of both show neither, and a fit to them gains nothing."""
    splats = make_scene(6000, sh_degree=0)
    copy = splats.take(np.arange(6000))
    copy.means[:, 0] += 1e5
    cameras = automatic_cameras(splats, 4, width=256, height=256, split="test")
    both = concatenate([splats, copy])
    alone, _ = nanogs.simplify(splats, ratio=0.1, **options)
    beside, _ = nanogs.simplify(both, ratio=0.1, **options)
    lost = quality(splats, alone, cameras) - quality(splats, beside, cameras)
    assert lost < 1


def hedge(seed, count=3000):
    """Needles in a ball, thinner than a pixel and too few to hide each other."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=ball(count, 1.0).astype(np.float32),
        log_scales=np.log(np.tile(np.float32([0.05, 2e-4, 2e-4]), (count, 1))),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=np.ones((count, 1, 3), np.float32),
    )


def camera_of(focal, size=512):
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return Camera(size, size, focal, focal, size / 2, size / 2, pose, near=0.01)


@pytest.mark.parametrize(("pixels", "right"), [(512.0, True), (4096.0, False), (64.0, False)])
def test_needles_are_as_bright_over_a_range_of_distances(pixels, right):
    """Seen as a whole and from four times as near: too faint once and too bright once, by less
    than a factor of two, and right in sum. Of eight hedges, since one differs from the next."""
    before, after = np.zeros((2, 2))
    for splats in map(hedge, range(8)):
        whole = dilation(splats.means.astype(float), splats.opacities(), RenderMode.DEFAULT, 512)
        focal = 4.0 * np.sqrt(0.3) / np.median(whole.at(splats.means.astype(float)))
        small, _ = nanogs.simplify(splats, ratio=0.1, preset="fast", pixels=pixels)
        cameras = [camera_of(focal), camera_of(focal * NEARER)]
        before += [view.mean() for view in over_black(splats, cameras)]
        after += [view.mean() for view in over_black(small, cameras)]
    far, near = after / before
    assert (0.5 < far < 1 < near < 2 and sum(after) == pytest.approx(sum(before), rel=0.1)) == right
