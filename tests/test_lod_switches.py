"""Switches between levels: from where viewers draw a level, and its quality there."""

import json
import math
from dataclasses import astuple

import numpy as np
import pytest

import nanogs
from builders import random_splats
from launch import run
from nanogs.lod.manifest import describe_levels
from nanogs.lod.streamed_sog import StreamedSog
from nanogs.lod.tiles import Tiles
from nanogs.raster.rendering import prepare, render
from nanogs.scoring.switch_views import LEAST_PIXELS, magnified, switch_views, typical_deviation
from nanogs.sink import Written
from nanogs.switches import (
    GOOD_PSNR,
    GOOD_SSIM,
    SCREEN,
    SwitchQuality,
    distance_of,
    streamed_distance,
    tree_pixel,
)
from nanogs.views.automatic import automatic_cameras


@pytest.fixture(scope="module")
def splats():
    return random_splats(400, degree=1)


@pytest.fixture(scope="module")
def camera(splats):
    return automatic_cameras(splats, 1, width=96, height=64, split="test")[0]


def test_levels_of_a_streamed_sog_switch_at_the_distances_of_the_engine():
    assert [streamed_distance(level) for level in (1, 2, 3)] == [5, 15, 45]
    pixel = StreamedSog(100).switch_pixel(2, 0.3)
    assert pixel * SCREEN == pytest.approx(2 * 15 * math.tan(math.pi / 8))
    assert distance_of(pixel) == pytest.approx(15)


def test_tiles_switch_where_their_error_is_sixteen_pixels():
    assert Tiles(100).switch_pixel(1, 0.5) == pytest.approx(4 * 0.5 / 16)


def test_trees_switch_where_splats_are_a_pixel_wide():
    assert tree_pixel(0.5) == 1


@pytest.mark.parametrize("factor", [0.5, 0.75, 1.0])
def test_pictures_from_farther_away_are_smaller(camera, factor):
    far = magnified(camera, factor)
    assert (far.width, far.height) == (96 * factor, 64 * factor)
    assert far.fx == camera.fx * factor


def test_pictures_stay_large_enough_for_ssim(camera):
    assert magnified(camera, 1e-6).height == LEAST_PIXELS


def test_from_nearer_only_the_middle_of_the_picture_is_rendered(splats, camera):
    near, larger = magnified(camera, 3), camera.resized(288, 192)
    model = prepare(splats)
    whole = render(model, larger).color
    assert np.array_equal(render(model, near).color, whole[64:128, 96:192])


def test_pictures_are_scaled_by_the_size_of_a_pixel_in_the_scene(splats, camera):
    views = switch_views(splats, [camera])
    depth = render(prepare(splats), camera, depth=True)
    pixel_size = np.median(depth.depth[depth.alpha > 0.5]) / camera.fx
    [footprint] = views.footprints
    assert footprint == pytest.approx(pixel_size, rel=1e-3)
    found = views.judge(splats, 2 * footprint)
    assert astuple(found) == (distance_of(2 * footprint), math.inf, pytest.approx(1), 1, 48)
    assert not found.seen


def test_scores_are_those_of_pictures_from_the_switch_distance(splats, camera):
    small, _ = nanogs.simplify(splats, ratio=0.1, preset="fast")
    views = switch_views(splats, [camera])
    found = views.judge(small, views.footprints[0] / 2)
    alone = nanogs.compare(splats, small, cameras=magnified(camera, 2))
    assert (found.psnr, found.ssim) == (alone.models[0].psnr, alone.models[0].ssim)
    assert found.pixels == 96


def test_the_typical_deviation_is_that_along_the_longest_axis(splats):
    assert typical_deviation(splats) == pytest.approx(np.median(splats.scales().max(axis=1)))


@pytest.mark.parametrize(
    ("psnr", "ssim", "visible"),
    [
        (GOOD_PSNR, GOOD_SSIM, False),
        (GOOD_PSNR - 0.01, 1, True),
        (60, GOOD_SSIM - 0.001, True),
        (math.inf, 1, False),
    ],
)
def test_a_visible_switch_is_noted(splats, psnr, ssim, visible):
    _, report = nanogs.simplify(splats, ratio=0.5, preset="fast")
    level = Written(3, ("a",), 5, switch=(12.4, psnr, ssim, 8, 200.0))
    written = [level._replace(switch=None), level, level]
    manifest = describe_levels("a.ply", [report] * 3, written)
    assert manifest.levels[0].switch is None
    assert manifest.levels[1].switch.seen is visible
    notes = [note for note in manifest.notes if "switch" in note]
    assert len(notes) == 3 * visible  # one for each level, and what helps against all of them
    for number, note in enumerate(notes[:2], 1):
        assert note.startswith(f"Level {number}: the switch to it is visible in a viewer (")
        assert note.endswith("from 12.4 units on).")
    assert not notes or notes[2].startswith("A switch is visible below 33 dB or 0.95, where")


@pytest.mark.parametrize("name", ["a/lod-meta.json", "a/tileset.json", "a.ssog", "a.rad"])
def test_each_level_reports_its_quality_at_the_switch(scene, tmp_path, name):
    options = ["--preset", "fast", "--levels", "1,0.2,0.04", "--measure"]
    result = run("lod", scene, tmp_path / name, *options, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    first, *others = (level["switch"] for level in report["levels"])
    assert first is None
    assert all(each["psnr"] > 0 and each["ssim"] <= 1 and each["views"] == 8 for each in others)
    if name.endswith(("lod-meta.json", ".ssog")):
        assert [each["distance"] for each in others] == pytest.approx([5, 15])
    elif name.endswith(".rad"):
        models = [nanogs.load(tmp_path / name, level=level) for level in (1, 2)]
        widths = [2 * typical_deviation(model) for model in models]
        expected = [distance_of(width) for width in widths]
        assert [each["distance"] for each in others] == pytest.approx(expected)
    visible = [SwitchQuality(**each).seen for each in others]
    notes = [note[:36] for note in report["notes"] if "switch to it" in note]
    assert notes == [
        f"Level {n}: the switch to it is visible" for n, each in enumerate(visible, 1) if each
    ]


def test_the_command_shows_the_switches(scene, tmp_path):
    options = ["--preset", "fast", "--levels", "1,0.2", "--measure"]
    result = run("lod", scene, tmp_path / "a/lod-meta.json", *options)
    assert "from" in result.stderr
    assert "there" in result.stderr
    assert " dB / 0." in result.stderr


def test_levels_made_in_blocks_report_their_switches(scene, tmp_path):
    manifest, _ = nanogs.write_levels(
        scene, tmp_path / "l", [1, 0.2], preset="fast", layout="streamed sog", block=150,
        measured=True,
    )  # fmt: skip
    level = nanogs.load(tmp_path / "l/lod-meta.json", level=1)
    original = nanogs.load(scene)
    cameras = automatic_cameras(original, 8, width=512, height=512, split="test")
    views = switch_views(original, cameras)
    again = views.judge(level, StreamedSog(9).switch_pixel(1, 0))
    assert astuple(manifest.levels[1].switch) == pytest.approx(astuple(again), rel=1e-6)


@pytest.mark.parametrize("block", [None, 300])
def test_levels_of_an_almost_transparent_model_are_kept_unmeasured(tmp_path, block):
    """From afar no view shows anything opaque."""
    splats = random_splats(300)
    splats.opacity_logits[:] = -5
    splats.log_scales[:] = -5
    nanogs.save(splats, tmp_path / "faint.ply")
    manifest, _ = nanogs.write_levels(
        tmp_path / "faint.ply", tmp_path / "l", [1, 0.5, 0.2], preset="fast",
        layout="streamed sog", environment="none", block=block, measured=True,
    )  # fmt: skip
    assert [level.switch for level in manifest.levels] == [None] * 3
    assert sum("Nothing was rendered or measured" in note for note in manifest.notes) == 1
    assert len(nanogs.load(tmp_path / "l/lod-meta.json", level=1)) == 150


def test_plain_level_files_have_no_switches(splats, tmp_path):
    manifest, _ = nanogs.write_levels(
        splats, tmp_path / "l", [1, 0.1], preset="fast", measured=True
    )
    assert "switch" not in manifest.to_dict()["levels"][1]
    quick, _ = nanogs.write_levels(
        splats, tmp_path / "s", [1, 0.1], preset="fast", layout="streamed sog"
    )
    assert quick.levels[1].switch is None
