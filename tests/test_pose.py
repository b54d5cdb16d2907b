"""Moved, turned and scaled models look the same from cameras that are moved with them."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import nanogs
from builders import model_bytes, random_splats
from launch import run as run_command
from nanogs.datasets.nerfstudio import moved
from nanogs.errors import OptionError
from nanogs.frames import change_frame
from nanogs.pose import pose_of_options
from nanogs.raster.rendering import render
from nanogs.source import InMemory, Posed
from nanogs.views.automatic import automatic_cameras
from npm_packages import splat_transform
from strategies import assert_same

ANGLES = st.tuples(*[st.floats(-360, 360)] * 3)
SHIFTS = st.tuples(*[st.floats(-50, 50)] * 3)


@settings(max_examples=20, deadline=None)
@given(ANGLES, SHIFTS, st.floats(0.01, 100), st.integers(0, 3))
def test_a_transformed_model_looks_the_same_from_a_transformed_camera(angles, shift, scale, degree):
    splats = random_splats(60, degree=degree, seed=degree)
    pose = pose_of_options(scale, angles, shift)
    if pose is None:
        return
    after = pose.applied(splats)
    for camera in automatic_cameras(splats, 2, width=48, height=32):
        expected, found = render(splats, camera), render(after, moved(camera, pose))
        # Splats at a threshold of alpha or of depth may fall on its other side by rounding.
        assert np.abs(expected.color - found.color).mean() < 2e-3
        assert np.quantile(np.abs(expected.color - found.color), 0.95) < 5e-3


@pytest.mark.parametrize(
    "angles", [(30, 0, 0), (0, -40, 0), (0, 0, 75), (10, 20, 30), (90, 90, 90)]
)
def test_turns_are_about_x_then_y_then_z(angles):
    pose = pose_of_options(2.0, angles, (1, 2, 3))
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()  # lower case: fixed axes
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(pose.means(points), 2 * points @ turn.T + (1, 2, 3), atol=1e-12)


def test_quarter_turns_are_exact():
    splats = random_splats(50)
    after = pose_of_options(1.0, (90, 0, 0), (0, 0, 0)).applied(splats)
    x, y, z = splats.means.T
    assert np.array_equal(after.means, np.stack([x, -z, y], axis=1))


def test_only_what_changes_is_touched():
    splats = dataclasses.replace(random_splats(50), comments=("Vertical Axis: z", "mine"))
    assert pose_of_options(1.0, (0, 0, 0), (0, 0, 0)) is None
    shifted = pose_of_options(1.0, (0, 0, 0), (0, 0, 4)).applied(splats)
    assert_same(dataclasses.replace(shifted, means=splats.means), splats)
    scaled = pose_of_options(0.5, (0, 0, 0), (0, 0, 0)).applied(splats)
    assert np.array_equal(scaled.means, splats.means / 2)
    np.testing.assert_allclose(scaled.log_scales, splats.log_scales + np.log(0.5), atol=1e-6)
    assert (scaled.comments, np.shares_memory(scaled.sh, splats.sh)) == (splats.comments, True)
    turned = pose_of_options(1.0, (0, 0, 20), (0, 0, 0)).applied(splats)
    assert turned.comments == ("mine",)
    assert np.array_equal(turned.log_scales, splats.log_scales)


def test_normals_are_turned_and_other_columns_are_not():
    rng = np.random.default_rng(2)
    extras = {name: rng.normal(size=9).astype("f4") for name in ("nx", "ny", "nz", "label")}
    splats = dataclasses.replace(random_splats(9), extras=extras)
    pose = pose_of_options(3.0, (10, 20, 30), (5, 5, 5))
    after = pose.applied(splats).extras
    normals = np.stack([extras[name] for name in ("nx", "ny", "nz")], axis=1) @ pose.rotation.T
    found = np.stack([after[name] for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(found, normals, atol=1e-6)
    assert np.array_equal(after["label"], extras["label"])


def test_values_that_are_not_finite_are_no_warning():
    splats = random_splats(6)
    splats.means[0], splats.quats[1], splats.log_scales[2], splats.sh[3] = (
        np.nan,
        np.inf,
        np.inf,
        np.nan,
    )
    splats.log_scales[4, 2] = -np.inf  # flat, as of 2DGS
    after = pose_of_options(2.0, (10, 20, 30), (1, 1, 1)).applied(splats)
    assert after.log_scales[4, 2] == -np.inf
    assert np.isfinite(after.means[5]).all()


def test_centres_that_become_infinite_are_noted(tmp_path):
    splats = random_splats(6)
    splats.means[0] = np.inf
    assert pose_of_options(2.0, (0, 0, 0), (1, 1, 1)).applied(splats).notes == splats.notes
    nanogs.save(random_splats(6), tmp_path / "a.ply")
    report = nanogs.convert(tmp_path / "a.ply", tmp_path / "b.ply", translate=(1e39, 0, 0))
    assert report.notes == ("6 splats are moved to infinity; move or scale the model less.",)


def test_a_source_is_transformed_block_by_block():
    splats = dataclasses.replace(random_splats(500), comments=("Vertical Axis: z",))
    pose = pose_of_options(2.0, (10, 20, 30), (1, 2, 3))
    source = Posed(InMemory(splats), pose)
    assert source.columns.comments == ()
    assert_same(source.load(), pose.applied(splats))
    assert_same(source.read(100, 200), pose.applied(splats).take(slice(100, 200)))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"scale": 0}, "The scale must be a number above 0, not 0"),
        ({"scale": -1.0}, "above 0"),
        ({"scale": float("inf")}, "above 0"),
        ({"scale": "2"}, "above 0"),
        ({"rotate": (1, 2)}, "The rotation must be three finite numbers"),
        ({"rotate": 90}, "The rotation must be three finite numbers"),
        ({"rotate": "xyz"}, "The rotation must be three finite numbers"),
        ({"translate": (1, 2, float("nan"))}, "The translation must be three finite numbers"),
    ],
)
def test_bad_transforms_are_refused(tmp_path, given, message):
    nanogs.save(random_splats(5), tmp_path / "a.ply")
    with pytest.raises(OptionError, match=message):
        nanogs.convert(tmp_path / "a.ply", tmp_path / "b.ply", **given)
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.parametrize("suffix", [".ply", ".npz"])
def test_convert_transforms_after_frame_and_filters(tmp_path, suffix):
    splats = random_splats(300)
    nanogs.save(splats, tmp_path / "a.ply")
    out = tmp_path / f"b{suffix}"
    done = run_command(
        "convert", tmp_path / "a.ply", out, "--frame", "rub", "--scale", "2", "--rotate", "0,0,90",
        "--translate", "-1,2,3", "--crop", "sphere:0,0,0,1", "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    kept = nanogs.filters.apply(splats, [nanogs.filters.sphere((0, 0, 0), 1)])[0]
    turned = change_frame(kept, "rdf", "rub")
    expected = pose_of_options(2.0, (0, 0, 90), (-1, 2, 3)).applied(turned)
    assert model_bytes(nanogs.load(out)) == model_bytes(expected)
    report = json.loads(done.stdout)
    assert report["splats"] == len(expected)
    x, y, z = (kept.means * np.float32([1, -1, -1])).T
    np.testing.assert_allclose(
        nanogs.load(out).means, np.stack([-1 - 2 * y, 2 + 2 * x, 3 + 2 * z], 1), atol=1e-5
    )


def test_the_command_refuses_what_are_no_three_numbers(tmp_path):
    nanogs.save(random_splats(5), tmp_path / "a.ply")
    for text, message in (
        ("1,2", "error: --rotate takes three finite numbers, such as 0,90,0, not '1,2'"),
        ("a,b,c", "--rotate takes three finite numbers"),
        ("1,inf,2", "--rotate takes three finite numbers"),
    ):
        done = run_command("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--rotate", text)
        assert done.returncode == 2
        assert message in done.stderr


def test_the_guide_shows_what_equals_the_actions_of_splat_transform(tmp_path):
    """Pairs of commands in docs/guide/convert.md, of which each writes the same model."""
    guide = (Path(__file__).parents[1] / "docs" / "guide" / "convert.md").read_text()
    section = guide.split("### As with splat-transform")[1].split("```")[1]
    commands = [line.split()[2:] for line in section.splitlines() if line.startswith("$ ")]
    model = random_splats(300, degree=3, spread=9)
    nanogs.save(model, tmp_path / "a.ply")
    for theirs, ours in zip(commands[::2], commands[1::2], strict=True):
        splat_transform(*(tmp_path / each if each.endswith(".ply") else each for each in theirs))
        expected = nanogs.load(tmp_path / "b.ply")
        assert len(expected) > 0
        assert run_command(*ours, "-w", "-q", cwd=tmp_path).returncode == 0
        found = nanogs.load(tmp_path / "b.ply")
        assert len(found) == len(expected)
        for name in ("means", "log_scales", "sh"):
            assert np.allclose(getattr(found, name), getattr(expected, name), atol=1e-5)
        assert np.allclose(found.unit_quats(), expected.unit_quats(), atol=1e-6)
