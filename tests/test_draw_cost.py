"""The draw cost of a model: splats per pixel, tile pairs, and the share of the largest splats."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from launch import run
from nanogs.errors import FormatError, OptionError
from nanogs.kernels.covering import cover_tiles
from nanogs.kernels.listing import list_tiles
from nanogs.kernels.project import HIDDEN, unpack_box
from nanogs.raster.rendering import prepare, project, project_rows
from nanogs.scoring.comparison import NamedModel, Scoring
from nanogs.scoring.on_sets import compare_on_sets
from nanogs.scoring.view_sets import view_sets
from nanogs.splats import RenderMode
from nanogs.views import covering
from nanogs.views.automatic import automatic_cameras
from nanogs.views.costing import pictures_of, protocol_of
from nanogs.views.covering import cost_on
from nanogs.views.plan import LEAST
from reference_raster import ROUNDING_MARGIN, splat_on_screen
from test_raster import make_camera, make_splats, one_splat


def cover_reference(splats, camera):
    """Return (H, W) counts of splats of alpha 1/255 or more, and where rounding cannot matter."""
    shape = (camera.height, camera.width)
    columns, rows = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    counts, sure = np.zeros(shape, int), np.ones(shape, bool)
    for i in np.flatnonzero(splats.finite()):
        projected = splat_on_screen(splats, camera, i)
        if projected is None:
            continue
        _, centre, covariance, opacity, _ = projected
        offsets = np.stack([columns - centre[0], rows - centre[1]], axis=-1)
        power = -0.5 * np.einsum("...i,ij,...j", offsets, np.linalg.inv(covariance), offsets)
        alpha = opacity * np.exp(np.minimum(power, 0))
        counts += alpha >= 1 / 255
        sure &= np.abs(alpha * 255 - 1) > ROUNDING_MARGIN
    return counts, sure


def covered(splats, camera):
    geometry, _, boxes = project_rows(prepare(splats), camera, sh_degree=0)
    order = np.flatnonzero(boxes != HIDDEN)
    lists = list_tiles(geometry, boxes, order, camera.width, camera.height)
    counts = np.zeros((camera.height, camera.width), np.int32)
    cover_tiles(geometry, *lists, counts)
    return counts


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10**6), mode=st.sampled_from(["default", "mip"]), size=st.floats(-4, 1))
def test_the_number_of_splats_on_each_pixel_equals_the_reference(seed, mode, size):
    splats = make_splats(n=30, seed=seed, size=size, render_mode=RenderMode(mode))
    wanted, sure = cover_reference(splats, make_camera())
    assert sure.mean() > 0.8
    np.testing.assert_array_equal(covered(splats, make_camera())[sure], wanted[sure])


def test_a_splat_of_known_size_covers_a_disc_of_known_radius():
    camera = make_camera(width=64, height=64, focal=30.0)
    splats = one_splat(scale=0.4, logit=0.0)  # 3 pixels, alpha 0.5
    deviation = np.sqrt((0.4 * 30 / 4) ** 2 + 0.3)
    radius = deviation * np.sqrt(2 * np.log(255 * 0.5))
    offsets = np.arange(64) + 0.5 - 32
    inside = np.hypot(*np.meshgrid(offsets, offsets)) <= radius
    np.testing.assert_array_equal(covered(splats, camera), inside)


def test_tile_pairs_are_counted_as_the_rasteriser_lists_them():
    model = random_splats(500, seed=2)
    cameras = [make_camera(100, 70, 60.0), make_camera(40, 90, 20.0)]
    cost = cost_on(model, cameras, protocol_of(cameras, "given"))
    lists = [project(prepare(model), camera) for camera in cameras]
    assert cost.tile_pairs == sum(len(view_lists.entries) for view_lists in lists) / 2
    assert cost.drawn == sum(len(view_lists.order) for view_lists in lists) / 2
    boxes = [
        unpack_box(box)[2:] for view_lists in lists for box in view_lists.boxes if box != HIDDEN
    ]
    assert cost.tile_pairs <= sum(across * down for across, down in boxes) / 2
    counts = np.concatenate([covered(model, camera).reshape(-1) for camera in cameras])
    assert cost.splats_a_pixel == pytest.approx(counts.mean(), rel=1e-12)
    assert cost.most_a_pixel == np.percentile(counts, 99, method="inverted_cdf")


def test_a_hundredth_of_the_pixels_may_be_covered_more_often():
    camera = make_camera(width=20, height=20, focal=10.0)
    for alpha, pixels, most in ((0.02, 4, 0), (0.5, 12, 1)):  # of 400 pixels
        splats = one_splat(scale=1e-3, logit=np.log(alpha / (1 - alpha)))
        assert covered(splats, camera).sum() == pixels
        assert cost_on(splats, [camera], protocol_of([camera], "given")).most_a_pixel == most


def test_the_largest_share_is_that_of_a_hundredth_of_the_splats():
    camera = make_camera(640, 640, 300.0)
    small = make_splats(199, size=-6.0, spread=0.1)
    large = make_splats(2, size=1.0, seed=5, spread=0.1, opacity_logits=np.full(2, 4.0))
    columns = ("means", "log_scales", "quats", "opacity_logits", "sh")
    both = replace(
        small,
        **{name: np.concatenate([getattr(small, name), getattr(large, name)]) for name in columns},
    )
    tiles = np.sort(np.bincount(project(prepare(both), camera).entries, minlength=201))
    cost = cost_on(both, [camera], protocol_of([camera], "given"))
    assert cost.largest_share == tiles[-3:].sum() / tiles.sum(), "3 of 201 are a hundredth or more"
    assert cost.largest_share > 0.6


def test_the_cost_does_not_depend_on_blocks_or_threads(tmp_path, monkeypatch):
    model = random_splats(700, seed=8)
    model.means[::50] = np.nan
    nanogs.save(model, tmp_path / "a.npz")
    in_memory = nanogs.draw_cost(nanogs.load(tmp_path / "a.npz"), pixels=96, views=3, threads=1)
    monkeypatch.setattr(covering, "DRAWN_ROWS", 64)
    with nanogs.open(tmp_path / "a.npz") as source:
        assert nanogs.draw_cost(source, pixels=96, views=3, threads=2) == in_memory
    assert nanogs.draw_cost(tmp_path / "a.npz", pixels=96, views=3, max_memory="1GB") == in_memory
    assert in_memory.protocol.views == 3
    assert in_memory.protocol.split == "test"


def test_larger_splats_cost_more_to_draw():
    model = random_splats(300, seed=9)
    cameras = [make_camera(128, 128, 60.0)]
    larger = replace(model, log_scales=model.log_scales + 0.5)
    before, after = (
        cost_on(splats, cameras, protocol_of(cameras, "given")) for splats in (model, larger)
    )
    assert after.splats_a_pixel > 1.3 * before.splats_a_pixel
    assert after.tile_pairs > before.tile_pairs


def test_a_model_out_of_view_costs_nothing():
    model = random_splats(30)
    away = [replace(make_camera(), world_to_camera=np.diag([1.0, 1, -1, 1]))]
    behind = replace(model, means=model.means + np.float32([0, 0, 50]))
    cost = cost_on(behind, away, protocol_of(away, "given"))
    assert (cost.splats_a_pixel, cost.most_a_pixel, cost.tile_pairs, cost.largest_share) == (
        0.0, 0, 0.0, 0.0,
    )  # fmt: skip


def test_given_views_have_no_split_and_the_largest_decides_on_the_memory():
    cameras = [make_camera(), replace(make_camera(), width=300, height=200)]
    assert pictures_of(cameras, 8, 512) == (60_000, 2)
    assert (protocol_of(cameras, "given").split, protocol_of(cameras, "auto").split) == (
        None,
        "test",
    )


def test_impossible_arguments_are_refused(tmp_path):
    model = random_splats(30)
    with pytest.raises(OptionError, match="no camera file"):
        nanogs.draw_cost(model, cameras=tmp_path / "none.json")
    with pytest.raises(OptionError, match="not 0 of 512 x 512"):
        nanogs.draw_cost(model, views=0)
    with pytest.raises(FormatError, match="no such file"):
        nanogs.draw_cost(tmp_path / "none.ply")


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A model, and a smaller one whose splats are larger."""
    folder = tmp_path_factory.mktemp("pair")
    model = random_splats(400, seed=11)
    small = model[::4]
    nanogs.save(model, folder / "large.ply")
    larger = replace(small, log_scales=small.log_scales + np.float32(0.4))
    nanogs.save(larger, folder / "small.ply")
    return folder / "large.ply", folder / "small.ply"


def test_compare_reports_the_draw_cost_of_each_model_on_its_views(pair, tmp_path):
    page = tmp_path / "page.html"
    arguments = ["compare", *pair, "--sizes", "64,96", "--views", "3"]
    result = run(*arguments, "--json", "--report", page, "--no-interactive")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    cameras = automatic_cameras(nanogs.load(pair[0]), 3, width=64, height=64, split="test")
    for index, found in enumerate([report["reference_cost"], report["models"][0]["cost"]]):
        cost = nanogs.draw_cost(pair[index], cameras)
        assert found["splats_a_pixel"] == cost.splats_a_pixel
        assert found["tile_pairs"] == cost.tile_pairs
        assert found["largest_share"] == cost.largest_share
        assert found["protocol"]["split"] == "test"
    assert report["further"][0]["models"][0]["cost"]["protocol"]["pixels"] == [96, 96]
    share = (
        report["models"][0]["cost"]["splats_a_pixel"] / report["reference_cost"]["splats_a_pixel"]
    )
    assert share > 0.25, "a quarter of the splats takes more than a quarter of the work"
    text = run(*arguments)
    assert f"{share:.1%}" in text.stdout
    assert "a pixel: number of splats that cover a pixel" in text.stderr
    assert f'<td data-is="draws">{100 * share:.1f} %</td>' in page.read_text(encoding="utf-8")


def test_models_that_are_read_in_blocks_have_the_same_draw_cost(pair):
    in_memory = nanogs.compare(pair[0], pair[1], pixels=64, views=2)
    streamed = compare_on_sets(
        NamedModel(pair[0].name, nanogs.open(pair[0])),
        [NamedModel(pair[1].name, nanogs.open(pair[1]))],
        view_sets(nanogs.load(pair[0]), ["auto"], [(64, 64)], views=2),
        scoring=Scoring(costs=True, budget=LEAST),
    )[0]
    assert streamed.models[0].cost == in_memory.models[0].cost
    assert streamed.reference_cost == in_memory.reference_cost
    assert in_memory.models[0].cost.share_of(in_memory.reference_cost) > 0.25
