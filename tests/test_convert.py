"""The command `nanogs convert`, and dropping bands of spherical harmonics."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import launch
import nanogs
from builders import random_splats
from nanogs import io
from nanogs.errors import OptionError
from nanogs.io.registry import formats
from nanogs.splats import RenderMode

WRITTEN = [known.suffix for known in formats() if known.write and known.readable]


def run(*arguments):
    return launch.run("convert", *arguments)


def assert_refused(result, folder, *words):
    """Check for exit code 2, one sentence on stderr, and no new files."""
    assert result.returncode == 2, result
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1, result.stderr
    for word in words:
        assert word in result.stderr
    assert [path.name for path in folder.iterdir() if path.name != "scene.ply"] == []


@pytest.fixture
def scene(tmp_path):
    label = {"label": np.arange(300, dtype=np.int32)}
    nanogs.save(random_splats(300, degree=2, extras=label), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", WRITTEN)
def test_convert_writes_the_same_bytes_as_save_in_every_format(scene, tmp_path, suffix):
    result = run(scene, tmp_path / f"a{suffix}")
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""
    assert "300 splats" in result.stderr
    nanogs.save(nanogs.load(scene), tmp_path / f"b{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_a_folder_is_written_if_the_output_is_meta_json(scene, tmp_path):
    path = tmp_path / "folder" / "meta.json"
    report = json.loads(run(scene, path, "--json").stdout)
    nanogs.save(nanogs.load(scene), tmp_path / "other" / "meta.json")
    written = launch.contents(path.parent)
    assert written == launch.contents(tmp_path / "other")
    assert report["output_bytes"] == sum(map(len, written.values()))
    second_report = json.loads(run(path, path, "-w", "--sh-degree", "0", "--json").stdout)
    assert second_report["input_bytes"] == report["output_bytes"]
    assert nanogs.load(path).sh_degree == 0
    assert "add -w" in run(scene, path).stderr


def test_losses_are_printed_as_notes_unless_quiet(scene, tmp_path):
    result = run(scene, tmp_path / "a.glb")
    assert "note: Extra columns are left out, .glb has no room for them: label." in result.stderr
    quiet = run(scene, tmp_path / "b.glb", "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
    assert "note" not in run(scene, tmp_path / "b.ply").stderr


def test_json_prints_the_report_and_nothing_else(scene, tmp_path):
    result = run(scene, tmp_path / "a.glb", "--json")
    report = json.loads(result.stdout)
    assert result.stderr == ""
    assert (report["splats"], report["sh_degree"], report["format"]) == (300, 2, "glb")
    assert report["render_mode"] == "default"
    assert report["input_bytes"] == scene.stat().st_size
    assert report["output_bytes"] == (tmp_path / "a.glb").stat().st_size
    assert report["notes"] == []
    assert "label" in report["losses"][0]
    assert set(report["seconds"]) == {"read", "write"}


def test_bands_above_the_given_sh_degree_are_dropped(scene, tmp_path):
    assert run(scene, tmp_path / "a.ply", "--sh-degree", "1").returncode == 0
    converted, original = nanogs.load(tmp_path / "a.ply"), nanogs.load(scene)
    assert np.array_equal(converted.sh, original.sh[:, :4])
    assert np.array_equal(converted.extras["label"], original.extras["label"])
    report = json.loads(run(scene, tmp_path / "b.ply", "--sh-degree", "3", "--json").stdout)
    assert report["sh_degree"] == 2


@pytest.mark.parametrize("mode", ["default", "mip"])
def test_a_page_is_reported_as_it_shows_the_model(tmp_path, mode):
    nanogs.save(random_splats(50, degree=4), tmp_path / "a.ply")
    report = nanogs.convert(tmp_path / "a.ply", tmp_path / "page.html", render_mode=mode)
    assert (report.format, report.splats, report.sh_degree) == ("html", 50, 3)
    assert report.render_mode == mode


def test_a_page_shows_surfels_in_the_default_mode(tmp_path):
    nanogs.save(replace(random_splats(50), render_mode=RenderMode.SURFEL), tmp_path / "a.sog")
    assert nanogs.load(tmp_path / "a.sog").render_mode is RenderMode.SURFEL
    report = nanogs.convert(tmp_path / "a.sog", tmp_path / "page.html")
    assert report.render_mode is RenderMode.DEFAULT


def test_the_output_may_replace_the_input(scene):
    assert "-w" in run(scene, scene).stderr
    report = json.loads(run(scene, scene, "-w", "--sh-degree", "0", "--json").stdout)
    assert report["output_bytes"] < report["input_bytes"]
    assert nanogs.load(scene).sh_degree == 0


def test_bad_input_and_output_are_refused(scene, tmp_path):
    assert_refused(run(tmp_path / "no.ply", tmp_path / "a.glb"), tmp_path, "no.ply", "no such file")
    assert_refused(run(scene, tmp_path / "a.obj"), tmp_path, "a.obj", ".glb")
    assert_refused(run(scene, tmp_path / "no" / "a.glb"), tmp_path, "does not exist")
    scene.write_bytes(scene.read_bytes()[:-1])
    assert_refused(run(scene, tmp_path / "a.glb"), tmp_path, "cut short")


@pytest.mark.parametrize("name", ["view.png", "view.WEBP", "a.b.jpg"])
def test_pictures_are_refused_with_the_command_that_makes_them(scene, tmp_path, name):
    message = f"{tmp_path / name} names a picture; make pictures with `nanogs render`."
    assert_refused(run(scene, tmp_path / name), tmp_path, message)


def test_splats_that_the_format_cannot_hold_are_refused(scene, tmp_path):
    model = nanogs.load(scene)
    model.means[7] = np.nan
    nanogs.save(model, scene, overwrite=True)
    assert_refused(run(scene, tmp_path / "a.glb"), tmp_path, "row 7", "the filter --drop-nan")
    result = run(scene, tmp_path / "a.glb", "--drop-nan")
    assert "drop-nan removed 1 splat; " in result.stderr
    assert len(nanogs.load(tmp_path / "a.glb")) == len(model) - 1


def test_an_invalid_sh_degree_is_refused(scene, tmp_path):
    result = run(scene, tmp_path / "a.ply", "--sh-degree", "5")
    assert_refused(result, tmp_path, "from 0 to 4, not 5")


def test_convert_never_imports_numba(scene, tmp_path):
    code = (
        "import sys; from nanogs.cli import main\n"
        "try: main()\n"
        "finally: assert 'numba' not in sys.modules"
    )
    command = [sys.executable, "-c", code, "convert", str(scene), str(tmp_path / "a.glb")]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("degree", range(5))
def test_with_sh_degree_keeps_the_lower_bands(degree):
    model = random_splats(5, degree=3)
    small = model.with_sh_degree(degree)
    assert small.sh_degree == min(degree, 3)
    assert np.array_equal(small.sh, model.sh[:, : (degree + 1) ** 2])
    assert small.sh.flags.c_contiguous
    assert io.losses(small, "a.ply") == ()


@pytest.mark.parametrize("degree", [-1, 5])
def test_with_sh_degree_refuses_an_invalid_degree(degree):
    with pytest.raises(OptionError, match="from 0 to 4"):
        random_splats(1).with_sh_degree(degree)


def test_turn_makes_the_half_turn_to_the_frame_rub(scene, tmp_path):
    result = run(scene, tmp_path / "a.ply", "--turn", "--json")
    assert json.loads(result.stdout)["frames"] == ["rub", "rdf"]
    turned, original = nanogs.load(tmp_path / "a.ply"), nanogs.load(scene)
    assert np.array_equal(turned.means, original.means * np.float32([1, -1, -1]))
    run(tmp_path / "a.ply", tmp_path / "b.ply", "--turn")
    assert np.array_equal(nanogs.load(tmp_path / "b.ply").sh, original.sh)
    run(scene, tmp_path / "a.glb")
    (tmp_path / "c").mkdir()
    refused = run(tmp_path / "a.glb", tmp_path / "c" / "a.ply", "--turn")
    assert_refused(refused, tmp_path / "c", "turned when it is read", "leave out --turn")


@pytest.mark.parametrize("version", [2, 3, 4])
def test_the_spz_version_can_be_chosen(scene, tmp_path, version):
    target = tmp_path / "a.spz"
    assert run(scene, target, "--spz-version", version).returncode == 0
    encoding = "zstd" if version == 4 else "gzip"
    assert io.inspect(target).encoding == encoding
    nanogs.save(nanogs.load(scene), tmp_path / "b.spz", format_options={"spz_version": version})
    assert (tmp_path / "b.spz").read_bytes() == target.read_bytes()
    options = ["-r", "0.5", "--preset", "fast", "--spz-version", version, "-q"]
    assert launch.run("simplify", scene, tmp_path / "c.spz", *options).returncode == 0
    assert io.inspect(tmp_path / "c.spz").encoding == encoding


@pytest.mark.parametrize("suffix", [".sog", ".spz"])
def test_the_palette_size_can_be_chosen(scene, tmp_path, suffix):
    target, expected = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    assert run(scene, target, "--palette", 3).returncode == 0
    nanogs.save(nanogs.load(scene), expected, format_options={"palette": 3})
    assert expected.read_bytes() == target.read_bytes()
    assert len(np.unique(nanogs.load(target).sh[:, 1:], axis=0)) == 3
    options = ["-r", "0.5", "--preset", "fast", "--palette", 2, "-q"]
    small = tmp_path / f"c{suffix}"
    assert launch.run("simplify", scene, small, *options).returncode == 0
    assert len(np.unique(nanogs.load(small).sh[:, 1:], axis=0)) == 2


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("suffix", [".sog", ".spz"])
def test_options_of_harmonics_without_an_effect_are_named_once(scene, tmp_path, suffix, degree):
    given = {"palette": 3, "bits": 7} | ({"sh_bits": 4} if suffix == ".spz" else {})
    target = tmp_path / f"a{suffix}"
    how = {"format_options": given, "overwrite": True}
    quick = {"ratio": 0.5, "preset": "fast", "sh_degree": degree, "format_options": given}
    model = nanogs.load(scene)
    few = nanogs.RefitParameters(steps=1, views=2, size=32)
    reports = [
        nanogs.convert(scene, target, sh_degree=degree, **how),
        nanogs.simplify(model, format=suffix, **quick)[1],
        nanogs.simplify_blocks(scene, target, overwrite=True, **quick),
        nanogs.simplify_blocks(scene, target, overwrite=True, block=150, **quick),
        nanogs.refit(
            model, model.with_sh_degree(degree), parameters=few, format=suffix,
            format_options=given,
        )[1],
    ]  # fmt: skip
    expected = [] if degree else [name for name in ("palette", "sh_bits") if name in given]
    options = {"suffix": suffix, "preset": "fast", "sh_degree": degree, "format_options": given}
    nanogs.write_levels(scene, tmp_path / "l", [0.5, 0.2], **options)
    manifest = json.loads((tmp_path / "l" / "levels.json").read_text())
    for notes in (*(report.notes for report in reports), manifest["notes"]):
        found = [note for note in notes if "had no effect" in note]
        assert [note.split("`")[1] for note in found] == expected


def test_invalid_format_options_and_those_of_other_formats_are_refused(scene, tmp_path):
    assert_refused(run(scene, tmp_path / "a.spz", "--spz-version", 1), tmp_path, "2, 3 or 4, not 1")
    assert_refused(run(scene, tmp_path / "a.ply", "--spz-version", 4), tmp_path, "for .spz files")
    message = "--palette must be a whole number from 1 to 65,536, not 0"
    assert_refused(run(scene, tmp_path / "a.sog", "--palette", 0), tmp_path, message)
    with pytest.raises(OptionError, match="no option 'quality'"):
        nanogs.save(nanogs.load(scene), tmp_path / "a.spz", format_options={"quality": 3})
    with pytest.raises(OptionError, match=r"not for \.ply"):
        io.check_writable(tmp_path / "a.ply", format_options={"spz_version": 3})
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]
