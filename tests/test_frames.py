"""Coordinate frames: a turned camera renders the same picture, and turning back loses nothing."""

import dataclasses
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import nanogs
from builders import model_bytes, random_splats
from launch import run as run_command
from nanogs.activations import rotations
from nanogs.errors import ModelError, OptionError
from nanogs.frames import FRAMES, TRAINED, Y_UP, change_between, change_frame
from nanogs.io.registry import formats
from nanogs.raster.rendering import render
from nanogs.views.automatic import automatic_cameras

# Computed by hand: the axes of each of these frames in the frame of training.
TURNS = {
    "rub": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "luf": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],  # glTF, as its reader turns it
    "rfu": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # Blender
    "fru": [[0, 0, 1], [1, 0, 0], [0, -1, 0]],  # Unreal, left-handed
    "ruf": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],  # Unity, left-handed
}


@pytest.mark.parametrize("target", TURNS)
def test_centres_follow_the_axes(target):
    splats = random_splats(9)
    assert change_between("rdf", target).matrix.tolist() == TURNS[target]
    turned = change_frame(splats, "rdf", target)
    assert np.array_equal(turned.means, splats.means @ np.array(TURNS[target], np.float32).T)


@pytest.mark.parametrize("target", TURNS)
@pytest.mark.parametrize("degree", range(5))
def test_a_turned_model_looks_the_same_from_a_turned_camera(degree, target):
    splats = random_splats(60, degree=degree, seed=degree)
    turn = np.eye(4)
    turn[:3, :3] = TURNS[target]
    changed = change_frame(splats, "rdf", target)
    for camera in automatic_cameras(splats, 2, width=48, height=40):
        turned = dataclasses.replace(camera, world_to_camera=camera.world_to_camera @ turn.T)
        expected, found = render(splats, camera).color, render(changed, turned).color
        assert expected.max() > 0.1
        assert np.abs(found - expected).max() < 1e-4
        assert np.abs(render(splats, turned).color - expected).max() > 0.05


@pytest.mark.parametrize("target", sorted(FRAMES))
def test_turning_there_and_back_restores_the_model(target):
    normals = {
        name: np.float32([1, 2, 3, 4]) * (i + 1) for i, name in enumerate(("nx", "ny", "nz"))
    }
    splats = random_splats(4, degree=3, extras=normals)
    turned = change_frame(splats, "rdf", target)
    restored = change_frame(turned, target, "rdf")
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        assert np.array_equal(getattr(restored, name), getattr(splats, name)), name
    assert restored.sh == pytest.approx(splats.sh, abs=1e-6)
    assert all(np.array_equal(restored.extras[name], normals[name]) for name in normals)
    assert (target == "rdf") == np.array_equal(turned.means, splats.means)
    in_two_steps = change_frame(change_frame(splats, "rdf", "bul"), "bul", target)
    assert np.array_equal(in_two_steps.means, turned.means)
    assert np.array_equal(in_two_steps.unit_quats(), turned.unit_quats())
    assert in_two_steps.sh == pytest.approx(turned.sh, abs=1e-6)


@pytest.mark.parametrize("target", ["rub", "ruf", "rfu", "fru", "fdr"])
def test_the_third_axis_of_flat_splats_stays_their_normal(target):
    splats = replace(random_splats(40, degree=1), render_mode="2dgs")
    splats.log_scales[:, 2] = -9
    splats.quats[0] = 0  # the identity
    turned = change_frame(splats, "rdf", target)
    assert np.array_equal(turned.log_scales[:, 2], splats.log_scales[:, 2])
    matrix = change_between("rdf", target).matrix
    axes = [rotations(each.unit_quats().astype(float)) for each in (splats, turned)]
    along = np.einsum("ij,njk,nik->nk", matrix, *axes)  # the axes of one and of the other
    assert np.abs(along) == pytest.approx(np.ones((40, 3)), abs=1e-5)
    usual = change_frame(replace(splats, render_mode="default"), "rdf", target)
    assert turned.sh == pytest.approx(usual.sh)
    restored = change_frame(turned, target, "rdf")
    assert np.array_equal(restored.log_scales, splats.log_scales)
    again = rotations(restored.unit_quats().astype(float))
    assert np.abs(np.einsum("njk,njk->nk", axes[0], again)) == pytest.approx(1, abs=1e-5)


def half_turn(splats):
    return change_frame(splats, TRAINED, Y_UP)


def test_two_half_turns_change_nothing():
    splats = random_splats(20, degree=3)
    assert model_bytes(half_turn(half_turn(splats))) == model_bytes(splats)
    assert not np.array_equal(half_turn(splats).means, splats.means)


def test_normals_are_turned_and_other_columns_are_not():
    extras = {"nx": np.float32([1]), "ny": np.float32([2]), "nz": np.float32([3]), "a": np.ones(1)}
    turned = change_frame(random_splats(1, extras=extras), "rdf", "fru").extras
    assert [column.tolist() for column in turned.values()] == [[3], [1], [-2], [1]]


@pytest.mark.parametrize(
    "command", [["convert"], ["simplify", "--ratio", "1"], ["lod", "--levels", "0.5"]]
)
def test_a_comment_on_the_vertical_axis_is_left_out_of_turned_files(command, tmp_path):
    comments = ("Generated by Nerstudio 1.1.5", "Vertical Axis: z")
    model = dataclasses.replace(random_splats(40, degree=0), comments=comments)
    nanogs.save(model, tmp_path / "a.ply")
    for frame, kept in (("rdf:rub", comments[:1]), ("rdf:rdf", comments)):
        args = [
            command[0],
            tmp_path / "a.ply",
            tmp_path / "b.ply",
            *command[1:],
            "--frame",
            frame,
            "-w",
        ]
        if command[0] == "lod":
            args[2] = tmp_path / "levels"
        run_command(*args)
        written = sorted((tmp_path / "levels").glob("*.ply")) or [tmp_path / "b.ply"]
        assert all(nanogs.load(path).comments == kept for path in written)


@pytest.mark.parametrize("name", ["", "rd", "rdd", "xyz", "rdfb", None, 3])
def test_invalid_frame_names_are_refused(name):
    assert len(FRAMES) == 48
    with pytest.raises(OptionError, match="where x, y and z point"):
        change_frame(random_splats(1), name, "rdf")


# --- the command


@pytest.fixture
def scene(tmp_path):
    nanogs.save(random_splats(300, degree=2), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def test_convert_turns_from_the_default_frame_of_the_format(scene, tmp_path):
    result = run_command("convert", scene, tmp_path / "a.ply", "--frame", "RUB", "--json")
    assert json.loads(result.stdout)["frames"] == ["rdf", "rub"]
    expected = half_turn(nanogs.load(scene))
    assert model_bytes(nanogs.load(tmp_path / "a.ply")) == model_bytes(expected)
    run_command("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--frame", "rub:rdf")
    assert (tmp_path / "b.ply").read_bytes() == scene.read_bytes()


def test_the_input_frame_can_be_given_for_formats_with_a_fixed_frame(scene, tmp_path):
    """A model with y up and the same model with y down become the same glTF file."""
    nanogs.save(half_turn(nanogs.load(scene)), tmp_path / "up.ply")
    run_command("convert", scene, tmp_path / "a.glb")
    run_command("convert", tmp_path / "up.ply", tmp_path / "b.glb", "--frame", "rub:")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
    run_command("convert", tmp_path / "a.glb", tmp_path / "c.ply", "--frame", "rub")
    loaded, expected = nanogs.load(tmp_path / "c.ply"), nanogs.load(tmp_path / "up.ply")
    assert np.array_equal(loaded.means, expected.means)


def test_simplify_turns_the_result(scene, tmp_path):
    options = ["--ratio", "0.5", "--preset", "fast"]
    run_command("simplify", scene, tmp_path / "a.ply", *options)
    run_command("simplify", scene, tmp_path / "b.ply", *options, "--frame", "ruf")
    expected = change_frame(nanogs.load(tmp_path / "a.ply"), "rdf", "ruf")
    assert model_bytes(nanogs.load(tmp_path / "b.ply")) == model_bytes(expected)


def test_frames_that_contradict_the_files_are_refused(tmp_path):
    up = {"spz_version": 4, "frame": "rub"}
    nanogs.save(random_splats(20), tmp_path / "up.spz", format_options=up)
    nanogs.save(random_splats(20), tmp_path / "a.ply")
    nanogs.save(random_splats(20), tmp_path / "a.glb")
    before = sorted(tmp_path.iterdir())
    states_rdf = {"spz_version": 4, "frame": "rdf"}
    for source, target, options, message in (
        ("up.spz", "b.ply", {"frame": ("rdf", "rub")}, "up.spz states the frame rub, but `frame`"),
        ("a.glb", "b.ply", {"frame": ("rub", "rdf")}, 'give `frame=("rdf", "rdf")`'),
        ("a.ply", "b.glb", {"frame": ("rdf", "ruf")}, "All .glb files use the same frame"),
        ("up.spz", "b.spz", {"format_options": states_rdf}, "states the frame rub, but the format"),
    ):
        files = tmp_path / source, tmp_path / target
        with pytest.raises(OptionError, match=re.escape(message)):
            nanogs.convert(*files, **options)
        with pytest.raises(OptionError, match=re.escape(message)):
            nanogs.simplify_blocks(*files, ratio=0.5, preset="fast", **options)
    with pytest.raises(OptionError, match=r"up\.spz states the frame rub"):
        nanogs.write_levels(tmp_path / "up.spz", tmp_path / "lv", [0.5], frame=("rdf", "rub"))
    with pytest.raises(OptionError, match=r"All \.glb files use the same frame"):
        nanogs.write_levels(
            tmp_path / "a.ply", tmp_path / "lv", [0.5], suffix=".glb", frame=("rdf", "ruf")
        )
    with pytest.raises(OptionError, match=r"All \.glb files use the same frame"):
        nanogs.write_levels(
            nanogs.load(tmp_path / "a.ply"), tmp_path / "lv", [0.5], layout="3d tiles",
            frame=("rdf", "rub"),
        )  # fmt: skip
    assert sorted(tmp_path.iterdir()) == before
    nanogs.convert(tmp_path / "up.spz", tmp_path / "c.ply", frame=("rub", "rdf"))
    assert len(nanogs.load(tmp_path / "c.ply")) == 20


@pytest.mark.parametrize(
    ("source", "target", "frame", "message"),
    [
        ("a.ply", "b.ply", "up", "where x, y and z point"),
        ("a.ply", "b.ply", ":", "needs a frame"),
        ("a.ply", "b.ply", "rub:", "b.ply is missing; give it too, as in --frame rub:rdf"),
        ("a.spz", "b.ply", "rdf", "does not state its own; give it too, as in --frame rub:rdf"),
        ("a.glb", "b.ply", "rub:rdf", "files state it themselves; give only the frame of OUT"),
        ("a.ply", "b.glb", "rub", "give that of IN alone, with --frame rub: and nothing"),
        ("a.ply", "b.ply --turn", "rub", "both turn the model"),
    ],
)
def test_incomplete_or_superfluous_frames_are_refused(tmp_path, source, target, frame, message):
    nanogs.save(random_splats(20), tmp_path / source)
    command = "simplify" if "--size" in target else "convert"
    target, *options = target.split()
    result = run_command(command, tmp_path / source, tmp_path / target, *options, "--frame", frame)
    assert (result.returncode, result.stderr.count("\n")) == (2, 1), result.stderr
    assert message in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == [source]


def test_frames_stated_by_formats_are_valid():
    assert all(known.axes in {*FRAMES, None} for known in formats())


VERSION_4 = ("--spz-version", "4")


def test_the_frame_need_not_be_given_for_a_file_that_states_it(tmp_path):
    nanogs.save(random_splats(20, degree=1), tmp_path / "a.ply")
    convert_args = ("convert", tmp_path / "a.ply", tmp_path / "a.spz", "--frame", "rub")
    result = run_command(*convert_args, *VERSION_4)
    assert result.returncode == 0, result.stderr
    description = run_command("info", tmp_path / "a.spz").stdout
    assert "frame            rub, as the file states" in description
    result = run_command("convert", tmp_path / "a.spz", tmp_path / "b.ply", "--frame", "rdf")
    assert result.returncode == 0, result.stderr
    loaded = nanogs.load(tmp_path / "b.ply")
    assert np.allclose(loaded.means, nanogs.load(tmp_path / "a.ply").means, atol=1e-3)
    args = ("simplify", tmp_path / "a.spz", tmp_path / "c.spz", "-r", "0.5", "--preset", "fast")
    result = run_command(*args, "--frame", "rdf", *VERSION_4)
    assert result.returncode == 0, result.stderr
    assert nanogs.open(tmp_path / "c.spz").frame == "rdf"
    refused = run_command("convert", tmp_path / "a.spz", tmp_path / "d.ply", "--frame", "rdf:rub")
    assert refused.returncode == 2
    assert "states the frame rub, but --frame says rdf" in refused.stderr


@pytest.fixture
def parts(tmp_path):
    """Files of one model that state different frames, or none."""
    splats = random_splats(20)
    for frame in ("rub", "rdf"):
        options = {"spz_version": 4, "frame": frame}
        nanogs.save(splats, tmp_path / f"{frame}.spz", format_options=options)
    for name in ("none.spz", "a.ply", "a.glb"):
        nanogs.save(splats, tmp_path / name)
    return tmp_path


@pytest.mark.parametrize(
    "names", [("rub.spz", "rdf.spz"), ("a.glb", "rub.spz"), ("a.ply", "none.spz", "rub.spz")]
)
def test_parts_of_one_scene_in_different_frames_are_refused(parts, names):
    files = [parts / name for name in names]
    with pytest.raises(ModelError, match=r"is in the frame .* cannot form one scene; turn one"):
        nanogs.simplify_blocks(files, parts / "out.ply", ratio=0.5, preset="fast")
    with pytest.raises(ModelError, match=r"is in the frame .* cannot form one scene; turn one"):
        nanogs.write_levels(files, parts / "levels", [0.5])
    assert not (parts / "out.ply").exists()


def test_models_in_another_frame_than_the_original_are_noted(parts, tmp_path):
    """Nothing is turned, and the scores of such models say nothing about their quality."""
    names = ("rub.spz", "rdf.spz", "a.glb", "none.spz")
    files, see = [parts / name for name in names], {"views": 2, "pixels": 16}
    said = (
        "rub.spz is in the frame rub and a.ply in rdf, as the files state or by convention, and"
        " neither was turned; if the pictures do not match, turn one by `nanogs convert` with"
    )
    assert nanogs.compare(parts / "a.ply", *files, **see).notes == (f"{said} `frame`.",)
    assert nanogs.compare(parts / "none.spz", *files, **see).notes == ()
    as_arrays = nanogs.load(parts / "a.ply")
    assert nanogs.compare(as_arrays, files[0], **see).notes == ()
    odd = shutil.copy(parts / "a.ply", tmp_path / "a.bin")
    assert nanogs.compare(nanogs.open(odd, format=".ply"), files[0], **see).notes == ()
    done = run_command("view", parts / "a.ply", files[0], "-o", tmp_path / "page.html", "--no-psnr")
    assert f"note: {said} --frame.\n" in done.stderr
    few = nanogs.RefitParameters(views=2, validation=2, rounds=1, size=16)
    _, report = nanogs.refit(parts / "a.ply", files[0], parameters=few)
    in_full = said.replace("rub.spz", str(files[0])).replace("a.ply", str(parts / "a.ply"))
    assert report.notes[0] == f"{in_full} `frame`."
    _, report = nanogs.refit(as_arrays, files[0], parameters=few)
    assert not any("frame" in note for note in report.notes)
    done = run_command(
        "refit", parts / "a.ply", files[0], tmp_path / "b.ply", "--views", "2", "--pixels", "16"
    )
    assert f"note: {in_full} --frame.\n" in done.stderr


def test_a_part_without_a_frame_is_taken_to_be_in_that_of_the_others(parts):
    options = {"ratio": 0.5, "preset": "fast"}
    files = parts / "none.spz", parts / "rub.spz"
    report = nanogs.simplify_blocks(files, parts / "out.spz", **options)
    said = f"Taken to be in the frame rub, as {files[1]} is: {files[0]}."
    assert said in report.notes
    assert nanogs.open(parts / "out.spz").frame == "rub"
    # The caller says where the parts without a frame are from.
    files = parts / "none.spz", parts / "a.ply", parts / "rub.spz"
    report = nanogs.simplify_blocks(files, parts / "out.ply", frame=("rub", "rdf"), **options)
    assert report.notes == ()


def test_the_option_is_checked_against_all_parts(parts):
    simplify = ("simplify", "--join", "-r", "0.5", "--preset", "fast", "--frame")
    for frame, names, message in (
        ("rdf", ("a.ply", "none.spz"), "none.spz is not known"),
        ("rdf", ("a.ply", "rub.spz"), "turn one of them first, by `nanogs convert` with --frame."),
        ("rdf:rub", ("a.ply", "rub.spz"), "rub.spz states the frame rub, but --frame says rdf"),
        ("rdf", ("rub.spz", "a.ply", "a.ply"), "cannot form one scene; turn one of them first"),
        ("rub", ("a.glb", "none.spz"), "none.spz is not known"),
        ("rub", ("a.glb", "none.spz"), "give it too, as in --frame rdf:rub."),
    ):
        files = [parts / name for name in (*names, "out.ply")]
        result = run_command(*simplify, frame, *files)
        assert (result.returncode, result.stderr.count("\n")) == (2, 1), result.stderr
        assert message in result.stderr


def test_the_frame_of_parts_that_are_turned_when_read_can_be_given(parts):
    files = [parts / name for name in ("a.glb", "none.spz")]
    options = ("-r", "0.5", "--preset", "fast", "--frame", "rdf:rub")
    result = run_command("simplify", "--join", *files, parts / "command.ply", *options)
    assert result.returncode == 0, result.stderr
    nanogs.simplify_blocks(files, parts / "b.ply", ratio=0.5, preset="fast", frame=("rdf", "rub"))
    assert (parts / "command.ply").read_bytes() == (parts / "b.ply").read_bytes()
