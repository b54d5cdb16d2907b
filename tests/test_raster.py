"""The rasteriser: comparisons with a reference in float64, difficult inputs and invariants."""

import dataclasses
import math
from itertools import pairwise

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from nanogs.errors import OptionError
from nanogs.kernels import harmonics, listing, raster
from nanogs.kernels import project as project_kernels
from nanogs.raster.camera import Camera, pick_evenly, split_evenly
from nanogs.raster.rendering import SURFEL_NOTE, blend, clipped, prepare, project, render
from nanogs.splats import RenderMode, Splats
from reference_raster import render_reference, sh_basis

TOLERANCE = 1e-4


LETTERS = "abcdefghij"


def make_camera(width=37, height=21, focal=30.0, **changes):
    camera = Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))
    return dataclasses.replace(camera, **changes)


def make_splats(n=40, seed=0, degree=0, size=-1.5, spread=0.8, **changes):
    """Splats around (0, 0, 4), where the default camera looks."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal((0, 0, 4), (1.5, 1, 1), (n, 3)),
        "log_scales": rng.normal(size, spread, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "opacity_logits": rng.normal(0, 2, n),
        "sh": rng.normal(0, 0.5, (n, (degree + 1) ** 2, 3)),
    }
    arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Splats(**(arrays | changes))


def one_splat(mean=(0, 0, 4), scale=0.3, logit=2.0, colour=0.9, **changes):
    return make_splats(
        1,
        means=np.array([mean], np.float32),
        log_scales=np.full((1, 3), np.log(scale), np.float32),
        opacity_logits=np.array([logit], np.float32),
        sh=np.full((1, 1, 3), (colour - 0.5) / harmonics.C0, np.float32),
        **changes,
    )


def check_against_reference(splats, camera, background=(0.2, 0.5, 0.9)):
    color, alpha, weighted, contributions, sure = render_reference(splats, camera, background)
    image = render(splats, camera, background=background, depth=True, contributions=True)
    assert sure.mean() > 0.9  # enough pixels must be left to compare
    assert np.abs(image.color - color)[sure].max() < TOLERANCE
    assert np.abs(image.alpha - alpha)[sure].max() < TOLERANCE
    hit = sure & (alpha > 0.01)
    depth = np.divide(weighted, alpha, out=np.full(alpha.shape, np.inf), where=alpha > 0)
    np.testing.assert_allclose(image.depth[hit], depth[hit], rtol=1e-3)
    assert np.isinf(image.depth[sure & (alpha == 0)]).all()
    # A splat at a threshold changes its sum by < 1 per pixel, and those behind it by as much.
    slack = 1e-4 * alpha.size + 2 * np.count_nonzero(~sure)
    assert np.abs(image.contributions - contributions[:, 0]).max() < slack
    return image, alpha


@pytest.mark.parametrize("degree", range(5))
def test_matches_reference_with_harmonics(degree):
    check_against_reference(make_splats(degree=degree, seed=degree), make_camera())


@pytest.mark.parametrize("mode", [RenderMode.DEFAULT, RenderMode.MIP])
def test_a_sharpened_view_has_every_third_pixel_of_a_picture_three_times_as_large(mode):
    splats = make_splats(60, 2, size=-3, spread=1.5, render_mode=mode)
    camera = make_camera().sharpened(1 / 3)
    image, _ = check_against_reference(splats, camera)
    large = render(splats, make_camera().resized(3 * camera.width, 3 * camera.height))
    # Splats of about 1/255 may be blended in one picture only.
    assert np.abs(image.alpha - large.alpha[1::3, 1::3]).max() < 0.01
    assert np.abs(image.alpha - render(splats, make_camera()).alpha).max() > 0.1


def test_probes_are_summed_with_the_weights_of_each_splat():
    splats, camera = make_splats(seed=3), make_camera()
    planes = np.random.default_rng(4).normal(size=(3, 21, 37)).astype(np.float32)
    *_, sums, sure = render_reference(splats, camera, probes=planes)
    view = project(prepare(splats), camera)
    found = blend(view, camera, view.features, np.empty(0, np.float32), planes)[2]
    assert found.shape == sums.shape == (40, 3)
    assert np.abs(sums).max() > 1
    slack = 1e-4 * 37 * 21 + 2 * np.abs(planes).max() * np.count_nonzero(~sure)
    assert slack < 0.1
    assert np.abs(found - sums).max() < slack


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("size", "spread"),
    [(-1.5, 0.8), (-2, 2.5), (1.5, 0.5), (-6, 0.5)],
    ids=["usual", "needles", "huge", "tiny"],
)
def test_matches_reference_for_every_size(seed, size, spread):
    check_against_reference(make_splats(60, seed, size=size, spread=spread), make_camera())


@pytest.mark.parametrize("mode", [RenderMode.MIP, RenderMode.SURFEL])
def test_matches_reference_in_other_render_modes(mode):
    splats = make_splats(80, size=-3, render_mode=mode)
    image, _ = check_against_reference(splats, make_camera())
    assert image.notes == ((SURFEL_NOTE,) if mode is RenderMode.SURFEL else ())


def test_mip_compensation_dims_splats_smaller_than_a_pixel():
    tiny = one_splat(scale=0.01)
    mip = dataclasses.replace(tiny, render_mode=RenderMode.MIP)
    camera = make_camera(36, 22)
    assert 0 < render(mip, camera).alpha.max() < 0.1 * render(tiny, camera).alpha.max()


def test_matches_reference_with_off_centre_principal_point_and_unequal_focal_lengths():
    camera = make_camera(fx=22.0, fy=41.0, cx=5.25, cy=17.5)
    check_against_reference(make_splats(80, size=-0.5), camera)


def test_matches_reference_from_a_turned_camera():
    angle = 0.7
    pose = np.eye(4)
    pose[:3, :3] = [
        [math.cos(angle), 0, -math.sin(angle)],
        [0, 1, 0],
        [math.sin(angle), 0, math.cos(angle)],
    ]
    pose[:3, 3] = (0.3, -0.2, 1.5)
    check_against_reference(make_splats(80, 3, degree=3), make_camera(world_to_camera=pose))


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (64, 5)])
def test_matches_reference_at_odd_sizes(size):
    check_against_reference(make_splats(50, 5), make_camera(*size))


def test_matches_reference_inside_the_cloud_with_splats_behind_and_far_beside():
    rng = np.random.default_rng(7)
    means = rng.normal(0, 2, (200, 3)).astype(np.float32)
    image, _ = check_against_reference(make_splats(200, 7, means=means), make_camera())
    assert image.drawn < 150


def test_matches_reference_where_many_splats_fill_the_pixels():
    logits = np.full(300, 3, np.float32)
    splats = make_splats(300, 8, size=-0.5, opacity_logits=logits)
    image, alpha = check_against_reference(splats, make_camera())
    assert alpha.max() > 0.9995
    assert image.alpha.max() < 1 - 0.9e-4  # the splat that would pass 1 - 1e-4 is not blended


def test_matches_reference_with_opacities_of_one_and_zero():
    logits = np.tile(np.array([np.inf, -np.inf, 0, 90, -90], np.float32), 12)
    check_against_reference(make_splats(60, 9, opacity_logits=logits), make_camera())


def test_opaque_splat_stops_at_alpha_099():
    image = render(one_splat(scale=5.0, logit=np.inf), make_camera(1, 1))
    assert image.alpha[0, 0] == pytest.approx(0.99, abs=1e-6)


def test_transparent_splat_is_not_drawn_nor_counted_as_broken():
    image = render(one_splat(logit=-np.inf), make_camera())
    assert (image.drawn, image.skipped) == (0, 0)
    assert not image.alpha.any()


@pytest.mark.parametrize(("z", "drawn_count"), [(0.2, 0), (0.1, 0), (-4, 0), (0.201, 1)])
def test_splats_up_to_the_near_plane_are_culled(z, drawn_count):
    camera = make_camera(near=float(np.float32(0.2)))
    assert render(one_splat((0, 0, z)), camera).drawn == drawn_count


def test_pixel_centres_are_at_half_integers():
    splats = one_splat((1.0, -0.5, 4.0), scale=0.02)
    camera = make_camera(32, 16, 32.0, cx=8.5, cy=12.5)
    alpha = render(splats, camera).alpha
    assert np.unravel_index(alpha.argmax(), alpha.shape) == (8, 16)
    assert alpha[8, 15] == pytest.approx(alpha[8, 17], rel=1e-4)


def test_nearer_splats_hide_farther_ones_whatever_their_order():
    near = one_splat((0, 0, 2), scale=2.0, logit=9, colour=1.0)
    far = one_splat((0, 0, 6), scale=2.0, logit=9, colour=0.0)
    stacked = [
        dataclasses.replace(
            a,
            **{
                f: np.concatenate([getattr(a, f), getattr(b, f)])
                for f in ("means", "log_scales", "quats", "opacity_logits", "sh")
            },
        )
        for a, b in ((near, far), (far, near))
    ]
    images = [render(splats, make_camera(5, 5)).color for splats in stacked]
    assert images[0].min() > 0.98
    np.testing.assert_array_equal(*images)


def test_equal_depths_are_blended_by_index():
    splats = make_splats(2, means=np.full((2, 3), (0, 0, 3), np.float32))
    splats = dataclasses.replace(
        splats,
        opacity_logits=np.full(2, 9, np.float32),
        log_scales=np.full((2, 3), 2, np.float32),
        sh=np.array([[[1.7] * 3], [[-1.7] * 3]], np.float32),
    )
    first, second = (
        render(splats.take(np.array(rows)), make_camera()) for rows in ([0, 1], [1, 0])
    )
    assert first.color.min() > 0.9
    assert second.color.max() < 0.1


@pytest.mark.parametrize("nearer_row", [0, 1])
def test_adjacent_float32_depths_are_sorted_correctly(nearer_row):
    depth = np.float32(3)
    means = np.array([(0, 0, np.nextafter(depth, np.float32(4)))] * 2, np.float32)
    means[nearer_row, 2] = depth
    splats = make_splats(
        2,
        means=means,
        log_scales=np.full((2, 3), 2, np.float32),
        opacity_logits=np.full(2, 9, np.float32),
        sh=np.array([[[1.7] * 3], [[-1.7] * 3]], np.float32),
    )
    assert (render(splats, make_camera()).color.mean() > 0.5) == (nearer_row == 0)


def test_nonfinite_rows_are_skipped_and_counted():
    splats = make_splats(20)
    broken = {name: getattr(splats, name).copy() for name in ("means", "quats", "sh")}
    broken["means"][0, 0] = np.nan
    broken["quats"][1, 2] = np.nan
    broken["sh"][2, 0, 1] = np.inf
    broken["means"][3, 2] = np.inf
    logits = splats.opacity_logits.copy()
    logits[4] = np.nan
    dirty = dataclasses.replace(splats, **broken, opacity_logits=logits)
    image = render(dirty, make_camera(), contributions=True)
    assert image.skipped == 5
    np.testing.assert_array_equal(
        image.color, render(splats.take(np.arange(5, 20)), make_camera()).color
    )
    assert not image.contributions[:5].any()


def test_extreme_values_give_finite_pixels():
    splats = make_splats(60, 11, spread=30.0)
    means = splats.means.copy()
    means[::3] *= np.float32(1e30)
    log_scales = np.minimum(splats.log_scales, 80)
    log_scales[::4] = -np.inf
    splats = dataclasses.replace(splats, means=means, log_scales=log_scales)
    image = render(splats, make_camera(), contributions=True)
    assert np.isfinite(image.color).all()
    assert np.isfinite(image.contributions).all()


def test_needle_of_a_million_pixels_keeps_its_width():
    splats = one_splat((0, 0, 4))
    splats = dataclasses.replace(
        splats,
        log_scales=np.log(np.array([[1e5, 1e-3, 1e-3]], np.float32)),
        quats=np.array([[math.cos(0.4), 0, 0, math.sin(0.4)]], np.float32),
    )
    check_against_reference(splats, make_camera(width=64, height=64))


def test_model_without_splats_shows_the_background():
    empty = make_splats(3).take(np.zeros(3, bool))
    image = render(empty, make_camera(), background=(0.1, 0.2, 0.3), contributions=True)
    np.testing.assert_allclose(image.color[3, 4], (0.1, 0.2, 0.3), atol=1e-7)
    assert image.contributions.shape == (0,)


def test_float64_positions_are_subtracted_before_rounding_to_float32():
    splats = make_splats(50, 12)
    shift = np.array([4e6, -5e6, 300.0])
    moved = dataclasses.replace(splats, means=splats.means.astype(np.float64) + shift)
    pose = np.eye(4)
    pose[:3, 3] = -shift
    moved_image = render(moved, make_camera(world_to_camera=pose)).color
    assert np.abs(moved_image - render(splats, make_camera()).color).max() < TOLERANCE


@pytest.mark.parametrize("degree", [0, 1, 2, 5])
def test_sh_degree_leaves_out_the_higher_bands(degree):
    splats = make_splats(degree=2)
    cut = dataclasses.replace(splats, sh=splats.sh[:, : (min(degree, 2) + 1) ** 2].copy())
    np.testing.assert_array_equal(
        render(splats, make_camera(), sh_degree=degree).color, render(cut, make_camera()).color
    )


def test_harmonics_match_legendre_functions():
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(50, 3))
    for direction in directions / np.linalg.norm(directions, axis=1, keepdims=True):
        basis = np.zeros(25)
        harmonics.sh_basis(*direction, 4, basis)
        np.testing.assert_allclose(basis, sh_basis(direction, 4), atol=1e-12)


def test_prepared_model_renders_the_same_bytes():
    splats = make_splats(degree=1)
    prepared = prepare(splats)
    for _ in range(2):
        np.testing.assert_array_equal(
            render(prepared, make_camera()).color, render(splats, make_camera()).color
        )


def test_thread_count_changes_no_byte():
    splats, camera = make_splats(3000, 13, degree=1, size=-2), make_camera(150, 90, 120.0)
    threads = numba.get_num_threads()
    results = []
    try:
        for count in range(1, threads + 1):
            numba.set_num_threads(count)
            results.append(render(splats, camera, depth=True, contributions=True))
    finally:
        numba.set_num_threads(threads)
    for name in ("color", "alpha", "depth", "contributions"):
        for result in results[1:]:
            np.testing.assert_array_equal(getattr(result, name), getattr(results[0], name))


def test_asking_for_depth_and_contributions_changes_no_colour():
    splats, camera = make_splats(200, 14), make_camera()
    plain, full = render(splats, camera), render(splats, camera, depth=True, contributions=True)
    assert plain.depth is None
    assert plain.contributions is None
    np.testing.assert_array_equal(plain.color, full.color)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (make_camera(width=0), "A camera needs 1 to"),
        (make_camera(fx=0.0), "Camera '' needs finite intrinsics"),
        (make_camera(fy=-1.0), "Camera '' needs finite intrinsics"),
        (make_camera(cx=math.nan), "Camera '' needs finite intrinsics"),
        (make_camera(near=0.0), "Camera '' needs finite intrinsics"),
        (make_camera(world_to_camera=np.full((4, 4), np.nan)), "Camera '' needs a finite 4 x 4"),
        (make_camera(world_to_camera=np.eye(3)), "Camera '' needs a finite 4 x 4"),
        (
            make_camera(world_to_camera=np.diag([1.02, 1.02, 1.02, 1])),
            "camera '' is not a rotation",
        ),
        (make_camera(whole=(32.0, math.nan, 64.0, 64.0)), "Camera '' needs finite intrinsics"),
        (make_camera(whole=(32.0, 32.0, 64.0, 0.0)), "Camera '' needs a `whole` picture"),
        ([make_camera()], "A camera must be a nanogs.Camera, not list"),
    ],
)
def test_invalid_cameras_are_refused(camera, words):
    with pytest.raises(OptionError, match=words):
        render(make_splats(), camera)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("background", (0, 0)),
        ("background", (0, math.nan, 0)),
        ("sh_degree", -1),
        ("sh_degree", 1.5),
        ("sh_degree", "1"),
    ],
)
def test_invalid_options_are_refused(name, value):
    with pytest.raises(OptionError, match=f"^{name} must be"):
        render(make_splats(), make_camera(), **{name: value})


def test_tile_lists_have_every_tile_with_a_visible_pixel():
    splats, camera = make_splats(80, 15, size=-1, spread=1.5), make_camera(70, 50, 40.0)
    for i in range(len(splats)):
        one = splats.take(np.array([i]))
        view = project(prepare(one), camera)
        alpha = render(one, camera).alpha
        tiles_x = math.ceil(camera.width / raster.TILE)
        for tile in range(len(view.starts) - 1):
            y, x = (tile // tiles_x) * raster.TILE, (tile % tiles_x) * raster.TILE
            visible = alpha[y : y + raster.TILE, x : x + raster.TILE].any()
            listed = view.starts[tile + 1] > view.starts[tile]
            assert listed or not visible


@pytest.mark.parametrize("size", [(5000, 100), (100, 3000), (300, 300)])
def test_tile_lists_have_the_splats_that_meet_each_tile_nearest_first(size):
    width, height = size
    splats = make_splats(60, 3, size=-1, spread=1.5)
    view = project(prepare(splats), make_camera(width, height, 90.0))
    expected = [[] for _ in range(len(view.starts) - 1)]
    tiles_x, paths = math.ceil(width / raster.TILE), set()
    for index in view.order.tolist():
        left, top, across, down = project_kernels.unpack_box(int(view.boxes[index]))
        lowest = listing._lowest(view.geometry[index])
        whole = across == 1 or down == 1 or max(across, down) <= listing.SMALL
        paths.add((whole, across > listing.WIDEST, down > listing.HIGHEST))
        for ty in range(top, top + down):
            first, end = left, left + across
            if not whole:
                first, end = listing._tile_span(
                    view.geometry[index], lowest, left, across, ty, width, height
                )
            for tx in range(first, end):
                expected[ty * tiles_x + tx].append(index)
    assert len(paths) > 1
    found = [view.entries[a:b].tolist() for a, b in pairwise(view.starts)]
    assert found == expected


@pytest.mark.parametrize("scale", [1e6, 1e12, 1e18, 1e22])
@pytest.mark.parametrize("turn", [0.0, 5e-23, 1e-9, 0.3])
def test_splats_of_any_size_give_finite_pixels(scale, turn):
    """Nothing is drawn outside of the image either: with bounds checks, that would raise."""
    scales = np.array([[scale, 1e-3, 1e-3], [1, scale, scale], [0.1, 0.1, 0.1]])
    splats = make_splats(
        3,
        means=np.array([[0, 0, 5], [1, 2, 3], [0, 0, 4]], np.float32),
        log_scales=np.log(scales).astype(np.float32),
        quats=np.array([[1, 0, 0, turn], [1, turn, 0, 0], [1, 0, 0, 0]], np.float32),
    )
    image = render(splats, make_camera(256, 256, 200.0), contributions=True)
    assert np.isfinite(image.color).all()
    assert np.isfinite(image.contributions).all()


seeds = st.integers(0, 2**16)


@settings(max_examples=25)
@given(seeds, st.tuples(*[st.floats(0, 1)] * 3))
def test_background_is_added_by_transmittance(seed, background):
    splats, camera = make_splats(30, seed), make_camera()
    black, image = render(splats, camera), render(splats, camera, background=background)
    expected = black.color + (1 - black.alpha[..., None]) * np.array(background)
    assert np.abs(image.color - expected).max() < 1e-5


@settings(max_examples=25)
@given(seeds, st.tuples(*[st.integers(-64, 64)] * 3))
def test_moving_scene_and_camera_together_changes_nothing(seed, shift):
    splats = make_splats(30, seed)
    splats = dataclasses.replace(splats, means=splats.means.astype(np.float64))
    pose = np.eye(4)
    pose[:3, 3] = np.negative(shift)
    moved = dataclasses.replace(splats, means=splats.means + shift)
    here, there = render(splats, make_camera()), render(moved, make_camera(world_to_camera=pose))
    # Rounding may move a splat across the threshold alpha = 1/255, which changes no more than that.
    assert np.abs(here.alpha - there.alpha).max() < 0.01
    assert np.abs(here.alpha - there.alpha).mean() < 1e-5


@settings(max_examples=25)
@given(seeds)
def test_contributions_add_up_to_the_alpha_image(seed):
    image = render(make_splats(60, seed, size=-1), make_camera(), contributions=True)
    total = image.alpha.sum(dtype=np.float64)
    assert image.contributions.sum() == pytest.approx(total, rel=1e-5, abs=1e-3)
    assert (image.contributions >= 0).all()


@settings(max_examples=15)
@given(seeds)
def test_renders_at_twice_the_size_average_to_the_smaller_one(seed):
    """For a smooth scene, whose splats are larger than pixels."""
    splats = make_splats(20, seed, size=0.3, spread=0.2)
    small = render(splats, make_camera(20, 12, 15.0)).alpha
    large = render(splats, make_camera(40, 24, 30.0)).alpha
    pooled = large.reshape(12, 2, 20, 2).mean(axis=(1, 3))
    assert np.abs(pooled - small).max() < 0.03


def test_a_cropped_view_has_the_pixels_of_the_whole():
    """Near the edge too, where projections are clamped by the field of view of the whole image."""
    splats = make_splats(200, 5, size=0.5, spread=2.0)
    camera = make_camera(128, 96, 40.0)
    part = camera.cropped(16, 48, 32, 32)
    whole, some = render(splats, camera, depth=True), render(splats, part, depth=True)
    np.testing.assert_array_equal(some.color, whole.color[48:80, 16:48])
    np.testing.assert_array_equal(some.depth, whole.depth[48:80, 16:48])
    assert whole.alpha[48:80, 16:48].any()
    alone = dataclasses.replace(part, whole=None)
    assert np.abs(render(splats, alone).color - some.color).max() > 1e-3


def test_colours_are_shown_within_the_range_of_a_screen():
    values = np.array([np.nan, -1, 0.5, 2, np.inf], np.float32)
    assert clipped(values).tolist() == [0, 0, 0.5, 1, 1]


@pytest.mark.parametrize(
    ("count", "picked"), [(0, ""), (1, "f"), (2, "ch"), (3, "bfi"), (9, "abcdfghij"), (99, LETTERS)]
)
def test_items_are_picked_evenly_with_the_same_room_at_both_ends(count, picked):
    assert "".join(pick_evenly(LETTERS, count)) == picked
    kept, others = split_evenly(LETTERS, count)
    assert ("".join(kept), {*kept, *others}) == (picked, {*LETTERS})


def test_a_cropped_view_stays_the_same_part_of_its_whole():
    camera = make_camera(width=64, height=48)
    part = camera.cropped(16, 8, 32, 16)
    assert part.cropped(1, 2, 3, 4).whole == part.whole == (camera.cx, camera.cy, 64, 48)
    assert part.resized(64, 48).whole == (2 * camera.cx, 3 * camera.cy, 128, 144)


def test_a_cropped_view_is_reduced_like_the_whole():
    splats = make_splats(200, 5, size=0.5, spread=2.0)
    camera = make_camera(128, 96, 40.0)
    part = camera.cropped(16, 48, 32, 32).reduced(16)
    whole = render(splats, camera.reduced(64))
    np.testing.assert_allclose(render(splats, part).color, whole.color[24:40, 8:24], atol=1e-5)
    edge = dataclasses.replace(part, whole=None)
    assert np.abs(render(splats, edge).color - whole.color[24:40, 8:24]).max() > 1e-3


def test_cropped_views_can_be_fitted_to():
    """Also if they are larger than `view_size`, to which they are reduced."""
    splats = make_splats(60, 5, size=0.5, spread=2.0)
    cameras = [make_camera(128, 96, focal).cropped(16, 8, 64, 48) for focal in (40.0, 50.0, 60.0)]
    small, report = nanogs.simplify(splats, count=20, cameras=cameras, view_size=32, steps=2)
    assert len(small) == 20
    assert report.shown > 0


@pytest.mark.parametrize("scale", [1e-3, 0.1, 3.0])
def test_splats_culled_early_as_beside_the_image_reach_no_pixel(scale):
    random = np.random.default_rng(3)
    lens = np.array([40.0, 55.0, 20.0, 11.0, 37.0, 21.0, 0.01, 20.0, 11.0, 37.0, 21.0, 0.3])
    bounds = project_kernels.guard_bounds(lens)
    steepest = (
        40.0**2 * (1 + max(bounds[0] ** 2, bounds[1] ** 2)),
        55.0**2 * (1 + max(bounds[2] ** 2, bounds[3] ** 2)),
    )
    row, culled, hidden = np.empty(8), 0, 0
    for _ in range(3000):
        sizes = scale * np.exp(random.normal(0, 1.5, 3))
        factor = (np.linalg.qr(random.normal(size=(3, 3)))[0] * sizes).astype(np.float32)
        z = float(np.exp(random.normal(0, 1)))
        x, y = (z * random.normal(0, 1, 2)).tolist()
        reach = float(np.float32(random.uniform(1e-4, 11)))
        xx, yy, _ = project_kernels._project_gaussian(factor, x, y, z, np.eye(3), lens, bounds, row)
        sides = math.sqrt(reach * xx), math.sqrt(reach * yy)
        box = project_kernels._tile_box(row[0], row[1], *sides, lens[4], lens[5])
        hidden += box == project_kernels.HIDDEN
        if project_kernels._beside(factor, reach, x, y, z, lens, steepest):
            culled += 1
            assert box == project_kernels.HIDDEN
    assert culled > 0.2 * hidden
