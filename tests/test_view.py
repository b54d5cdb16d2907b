"""Pages with the viewer: their contents, and `nanogs view`. test_view_browser.py opens them."""

import base64
import dataclasses
import json
import os
import re
import shutil
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import nanogs
from builders import random_splats
from launch import run, run_here
from nanogs.cli.app import app
from nanogs.errors import ModelError, OptionError
from nanogs.protocol import Judged, Protocol
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import render
from nanogs.scoring.run import compare_files
from nanogs.scoring.viewing import page_path, view_files
from nanogs.splats import RenderMode
from nanogs.view import bundle
from nanogs.view import page as view_page
from nanogs.view.pack import DISTANCE, FARTHEST, in_page, pack, unpack
from nanogs.view.page import Shown, facts_of, render_page
from nanogs.views.opening import Opening, opening_for
from nanogs.views.poses import look_at
from test_cli import assert_refused
from test_views import cloud, room
from viewer_bundle import require_bundle

START = Opening(
    position=np.array([0.0, 0.0, -4.0]),
    target=np.zeros(3),
    up=np.array([0.0, -1.0, 0.0]),
    tangent=0.5,
    near=0.05,
)


def unpacked(packed, folder):
    """Load the packed model of a page, in the units of the page."""
    path = folder / "model.spz"
    path.write_bytes(packed.data)
    return nanogs.load(path)


def moved(splats, scale, shift):
    return dataclasses.replace(
        splats,
        means=(splats.means.astype(np.float64) * scale + shift).astype(np.float32),
        log_scales=splats.log_scales + np.float32(np.log(scale)),
    )


# The first view


def test_the_first_view_shows_a_whole_object_in_the_centre():
    splats = random_splats(2000)
    start = opening_for(splats, "orbit")
    pose = look_at(start.position, start.target, start.up)
    local = splats.means @ pose[:3, :3].T + pose[:3, 3]
    assert (local[:, 2] > start.near * start.distance).all()
    inside = np.abs(local[:, :2] / local[:, 2:]).max(axis=1) < start.tangent
    assert inside.mean() > 0.97
    assert np.linalg.norm(start.target) < 0.2  # of a cube with half-width 1 around the origin
    assert start.up @ (start.position - start.target) > 0


@settings(max_examples=15)
@given(
    scale=st.floats(1e-3, 1e3),
    shift=st.tuples(*[st.floats(-50, 50)] * 3),
)
def test_the_first_view_moves_and_scales_with_the_scene(scale, shift):
    splats = random_splats(300)
    shift = scale * np.array(shift)
    start, other = opening_for(splats), opening_for(moved(splats, scale, shift))
    tolerance = 1e-3 * start.distance
    assert np.allclose((other.position - shift) / scale, start.position, atol=tolerance)
    assert np.allclose((other.target - shift) / scale, start.target, atol=tolerance)
    assert other.near == pytest.approx(start.near, rel=1e-3)


def test_a_page_starts_at_the_given_camera():
    splats = random_splats(500)
    pose = look_at(np.array([0.3, -1.0, -5.0]), np.array([0.5, 0, 0]), np.array([0.0, -1, 0]))
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, pose, near=0.1)
    start = opening_for(splats, camera)
    assert np.allclose(start.position, camera.position)
    ahead = (start.target - start.position) / start.distance
    assert np.allclose(ahead, pose[2, :3])
    assert start.distance == pytest.approx(5.1, rel=0.05)  # the distance to the centre of the model
    assert start.tangent == pytest.approx(240 / 500)
    assert start.near * start.distance == pytest.approx(0.1)


def test_a_camera_that_looks_away_orbits_a_point_ahead_of_it():
    pose = look_at(np.array([0.0, 0, -5]), np.array([0.0, 0, -9]), np.array([0.0, -1, 0]))
    start = opening_for(random_splats(500), Camera(64, 64, 50, 50, 32, 32, pose))
    assert start.distance > 0
    assert (start.target - start.position)[2] < 0


def test_a_model_of_one_splat_has_a_first_view():
    start = opening_for(random_splats(1))
    assert start.distance > 0
    assert np.isfinite(start.position).all()


def test_unknown_camera_kinds_and_zero_up_vectors_are_refused():
    with pytest.raises(OptionError, match="not 'outside'"):
        opening_for(random_splats(10), "outside")
    with pytest.raises(OptionError, match="Up must be"):
        opening_for(random_splats(10), "orbit", (0, 0, 0))


def test_the_first_view_in_a_room_orbits_what_it_looks_at():
    splats = cloud(room(20_000), size=0.06)
    start = opening_for(splats, "inside")
    pose, focal = look_at(start.position, start.target, start.up), 32 / start.tangent
    camera = Camera(64, 64, focal, focal, 32, 32, pose, near=start.near * start.distance)
    depth = render(splats, camera, depth=True).depth
    x, y = np.meshgrid(*[(np.arange(64) + 0.5 - 32) / focal] * 2)
    distances = depth * np.sqrt(1 + x * x + y * y)
    assert start.distance == pytest.approx(np.median(distances), rel=0.06)


# Packing a model


@settings(max_examples=20)
@given(scale=st.floats(1e-4, 1e4), seed=st.integers(0, 5), degree=st.integers(0, 3))
def test_a_packed_model_equals_the_model_in_page_units(tmp_path_factory, scale, seed, degree):
    splats = moved(random_splats(50, degree=degree, seed=seed), scale, np.full(3, 3 * scale))
    start = dataclasses.replace(
        START, position=scale * START.position, target=np.full(3, 2.5 * scale)
    )
    packed = pack(splats, start)
    shown = unpacked(packed, tmp_path_factory.mktemp("packed"))
    unit = DISTANCE / start.distance
    assert np.allclose(shown.means, in_page(splats.means, start), atol=2e-4 * DISTANCE)
    assert np.allclose(shown.log_scales, splats.log_scales + np.log(unit), atol=1 / 16)
    assert np.allclose(shown.opacities(), splats.opacities(), atol=1 / 255)
    turned = np.abs((shown.unit_quats() * splats.unit_quats()).sum(axis=1))
    assert (turned > 0.999).all()
    assert shown.sh_degree == degree
    assert np.allclose(shown.sh[:, 0], np.clip(splats.sh[:, 0], -3.3, 3.3), atol=0.02)
    assert not packed.mip


def test_a_far_splat_is_moved_nearer_with_the_same_apparent_size(tmp_path):
    splats = random_splats(3)
    splats.means[1] = (3e6, -4e6, 0)
    splats.log_scales[1] = np.log(2e5)
    packed = pack(splats, START)
    shown = unpacked(packed, tmp_path)
    distance = np.linalg.norm(shown.means[1])
    assert distance == pytest.approx(FARTHEST, rel=1e-3)
    assert np.allclose(shown.means[1] / distance, (0.6, -0.8, 0), atol=1e-3)
    assert np.allclose(shown.scales()[1] / distance, 2e5 / 5e6, rtol=0.05)
    assert any("1 splat farther" in note for note in packed.notes)
    assert pack(splats.take(np.array([0, 2])), START).notes == ()


def test_a_packed_model_is_read_back_in_units_of_the_scene():
    splats = moved(random_splats(200, degree=2), 0.01, np.array([500.0, -30.0, 4.0]))
    start = opening_for(splats)
    again = unpack(pack(splats, start), start)
    assert np.abs(again.means - splats.means).max() < 1e-3 * start.distance
    assert np.abs(again.log_scales - splats.log_scales).max() < 0.04
    direct = nanogs.io.round_trip(splats, "a.spz")
    assert np.abs(again.sh - direct.sh).max() == 0
    assert np.abs(again.opacity_logits - direct.opacity_logits).max() == 0


def test_notes_name_what_a_page_does_not_show(tmp_path):
    splats = random_splats(20, degree=4, extras={"label": np.arange(20)})
    splats.means[3] = np.nan
    splats.opacity_logits[4] = np.inf
    splats.log_scales[5, 0] = -np.inf
    packed = pack(splats, START)
    assert len(unpacked(packed, tmp_path)) == 19
    text = " ".join(packed.notes)
    assert "1 splat with a NaN or infinite value was not drawn" in text
    assert "above degree 3" in text
    assert "label" not in text  # viewers show no extra columns anyway
    surfels = dataclasses.replace(random_splats(5), render_mode=RenderMode.SURFEL)
    assert any("2dgs" in note for note in pack(surfels, START).notes)
    mip = dataclasses.replace(random_splats(5), render_mode=RenderMode.MIP)
    assert pack(mip, START).mip
    tiny = random_splats(5, degree=0)
    tiny.log_scales[:] = -40  # less than a pixel by far, also as the format has it
    assert pack(tiny, START).notes == ()
    nothing = random_splats(2)
    nothing.means[:] = np.inf
    with pytest.raises(ModelError, match="no finite"):
        pack(nothing, START)


def test_a_page_of_the_same_machine_is_compressed_less():
    splats = random_splats(2000, degree=0)
    assert len(pack(splats, START).data) < len(pack(splats, START, quick=True).data)


# The page


def shown_model(name="a.ply", count=20):
    return Shown(name, facts_of(count, 1000), pack(random_splats(count), START))


def without_licences(text):
    return re.sub(
        r'<script type="text/plain" id="nanogs-licences">.*?</script>', "", text, flags=re.DOTALL
    )


@pytest.fixture(scope="module")
def page():
    require_bundle()
    return render_page([shown_model(), shown_model("b.ply")], START, (0, 0.5, 1))


def test_a_page_loads_nothing_from_elsewhere(page):
    rest = without_licences(page)
    assert "://" not in rest
    assert not re.search(r"""\b(src|href|action)\s*=|url\(|@import""", rest)
    assert "default-src &#39;none&#39;" in rest
    assert "three.js authors" in page
    assert "WORLD LABS" in page
    assert "without restriction" in page


def test_a_page_contains_its_models_and_their_facts(page):
    scene = json.loads(re.search(r'id="nanogs-scene">(.*?)</script>', page)[1])
    assert [model["name"] for model in scene["models"]] == ["a.ply", "b.ply"]
    assert scene["models"][0]["facts"] == ["20 splats", "1.0 kB"]
    assert scene["background"] == "#0080ff"
    assert np.allclose(scene["camera"]["position"], (0, 0, -DISTANCE))
    for model in scene["models"]:
        text = re.search(f'id="{model["id"]}">(.*?)</script>', page)[1]
        assert base64.b64decode(text, validate=True)[:2] == b"\x1f\x8b"
    assert "<title>a.ply and b.ply</title>" in page


def test_model_names_are_escaped_in_the_page():
    require_bundle()
    name = "</script><script>alert(1)</script><!--"
    text = render_page([shown_model(name)], START, (0, 0, 0))
    assert "alert(1)" in text
    assert "<script>alert" not in text
    assert text.count("<!--") == 0


def test_facts_of_a_model():
    assert facts_of(1000, 2_500_000) == ("1,000 splats", "2.5 MB")
    small = facts_of(100, None, reference=1000, judged=Judged(31.254, 0.9, Protocol()))
    shares = ("100 splats (10.00\N{NO-BREAK SPACE}%)", "\N{EN DASH}")
    assert small == (*shares, "PSNR 31.25 dB", "on 8 held-out views of 512 pixels")
    assert facts_of(1000, 1, reference=1000)[0] == "1,000 splats"


def test_a_model_too_large_for_a_browser_is_refused(monkeypatch):
    require_bundle()
    # Not the bytes count, but the characters that stand for them.
    monkeypatch.setattr(view_page, "MOST_TEXT", len(shown_model().packed.data))
    with pytest.raises(ModelError, match=r"a\.ply is too large.*simplify"):
        render_page([shown_model()], START, (0, 0, 0))


def test_the_viewer_program_is_the_same_text_each_time(monkeypatch):
    require_bundle()
    first = bundle.program()
    bundle.program.cache_clear()
    monkeypatch.setattr("time.time", lambda: 1e9)
    assert bundle.program() == first
    assert len(first) < 2_000_000


# The command


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    splats = random_splats(400, degree=0)
    nanogs.save(splats, folder / "scene.ply")
    nanogs.save(splats.take(np.arange(0, 400, 4)), folder / "small.compressed.ply")
    return folder


def test_view_writes_a_page_of_one_model(files):
    require_bundle()
    result = run("view", "scene.ply", cwd=files)
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""
    # A machine with other work may be slow enough for lines of progress before this one.
    assert re.fullmatch(r"scene\.html: \d\.\d MB", result.stderr.splitlines()[-1])
    assert '"scene.ply"' in (files / "scene.html").read_text(encoding="utf-8")
    before = (files / "scene.html").read_bytes()
    assert_refused(run("view", "scene.ply", cwd=files), "scene.html", "-w")
    again = run("view", "scene.ply", "-w", "-q", cwd=files)
    assert (again.returncode, again.stderr) == (0, "")
    assert (files / "scene.html").read_bytes() == before  # the same input, the same bytes


@pytest.mark.parametrize(("option", "opened"), [("--json", 0), ("--quiet", 1)])
def test_a_page_is_not_opened_if_a_program_reads_the_output(
    files, tmp_path, monkeypatch, option, opened
):
    require_bundle()
    pages = []
    monkeypatch.setattr("webbrowser.open", lambda address: pages.append(address) or True)
    monkeypatch.setattr("nanogs.cli.browsing._has_screen", lambda: True)
    assert run_here("view", files / "scene.ply", "-o", tmp_path / "a.html", option) == 0
    assert len(pages) == opened


def test_view_reports_two_models_as_json(files, tmp_path):
    require_bundle()
    page_file = tmp_path / "page.html"
    inputs = (files / "scene.ply", f"tenth={files}/small.compressed.ply")
    views = ("--views", "2", "--pixels", "64")
    result = run("view", *inputs, *views, "-o", page_file, "--json")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    report = json.loads(result.stdout)
    assert report["output_bytes"] == page_file.stat().st_size
    assert [model["name"] for model in report["models"]] == ["scene.ply", "tenth"]
    assert [model["splats"] for model in report["models"]] == [400, 100]
    assert report["judged"]["protocol"]["views"] == 2
    line = f'"PSNR {report["judged"]["psnr"]:.2f} dB", "on 2 held-out views of 64 pixels"'
    assert line in page_file.read_text(encoding="utf-8")


def test_the_second_model_is_measured_as_compare_measures_it(files, tmp_path):
    require_bundle()
    inputs = [("a", files / "scene.ply"), ("b", files / "small.compressed.ply")]
    small = {"views": 2, "width": 48, "height": 48}
    report = view_files(inputs, tmp_path / "a.html", **small)
    comparison = compare_files(inputs[0], inputs[1:], views=2, sizes=[(48, 48)])
    assert report.judged == comparison.judged(0)
    unmeasured = view_files(inputs, tmp_path / "b.html", psnr=False)
    assert unmeasured.judged is None
    assert "PSNR" not in without_licences((tmp_path / "b.html").read_text(encoding="utf-8"))


def test_a_report_says_how_its_interactive_part_differs_from_the_models(tmp_path):
    require_bundle()
    splats = random_splats(100)
    splats.means[:3] *= 1000 / np.linalg.norm(splats.means[:3], axis=1, keepdims=True)
    splats.sh[:5, 0] = 9
    nanogs.save(splats, tmp_path / "a.ply")
    inputs = [(name, tmp_path / "a.ply") for name in "ab"]
    page, small = tmp_path / "a.html", {"views": 1, "sizes": [(32, 32)], "overwrite": True}
    told = compare_files(inputs[0], inputs[1:], report=page, interactive=True, **small)
    written = page.read_text(encoding="utf-8")
    plain = compare_files(inputs[0], inputs[1:], report=page, **small)
    packed = pack(nanogs.load(tmp_path / "a.ply"), opening_for(splats))
    assert len(packed.notes) == 3
    expected = [f"{name}, in 3D: {note}" for name in "ab" for note in packed.notes]
    assert list(told.notes) == [*plain.notes, *expected]
    assert "b, in 3D: 3 splats farther" in written
    # Not as if a .spz had been asked for.
    assert (
        "b, in 3D: 5 splats have base colours outside ±3.33, the range of .spz, in which" in written
    )
    assert nanogs.info(tmp_path / "a.ply").losses[".html"] == packed.notes[1:]


def test_pages_show_names_that_are_not_utf8(files, tmp_path):
    require_bundle()
    inputs, page = (
        [("a\udcff", files / "scene.ply"), ("b", files / "scene.ply")],
        tmp_path / "a.html",
    )
    view_files(inputs, page, psnr=False)
    assert "<title>a\\udcff and b</title>" in page.read_text(encoding="utf-8")
    compare_files(inputs[0], inputs[1:], views=1, sizes=[(32, 32)], report=page, overwrite=True)
    assert "<title>a\\udcff: comparison</title>" in page.read_text(encoding="utf-8")


def test_a_page_can_be_measured_on_roaming_views(files, tmp_path):
    require_bundle()
    inputs = [("a", files / "scene.ply"), ("b", files / "small.compressed.ply")]
    small = {"views": 2, "width": 48, "height": 48, "cameras": "roam"}
    report = view_files(inputs, tmp_path / "a.html", **small)
    assert report.judged.text.endswith("2 held-out roaming views of 48 pixels")
    assert report.judged.protocol.kind == "roam"


def test_reports_of_compare_have_an_interactive_part(files, tmp_path, monkeypatch):
    """On by default; left out on request, and with a note where the viewer was not built."""
    require_bundle()
    report = tmp_path / "report.html"
    arguments = ["compare", files / "scene.ply", files / "small.compressed.ply", "--views", "1"]
    arguments = [*map(str, arguments), "--pixels", "32", "--report", str(report), "-w"]

    def written(*more):
        result = CliRunner().invoke(app, [*arguments, *more])
        assert result.exit_code == 0, result.output
        text = report.read_text(encoding="utf-8")
        assert "://" not in re.sub(r"<svg.*?</svg>", "", without_licences(text), flags=re.DOTALL)
        return text, result.output

    text, _ = written()
    assert "nanogs-program" in text
    assert text.count('id="nanogs-model-') == 2
    plain, _ = written("--no-interactive")
    assert "nanogs-program" not in plain
    monkeypatch.setattr("nanogs.cli.compare.is_built", lambda: False)
    without, messages = written()
    assert without == plain
    assert "no interactive part" in messages


def test_default_names_of_pages():
    assert page_path([Path("a/b.compressed.ply")]) == Path("b.html")
    assert page_path([Path("b.ply"), Path("c.tenth.spz")]) == Path("b-c.tenth.html")
    assert page_path([Path("scan/meta.json")]) == Path("scan.html")
    assert page_path([Path("noformat")]) == Path("noformat.html")


def test_missing_inputs_and_folders_and_unknown_cameras_are_refused(files, tmp_path):
    require_bundle()
    scene, page_file = files / "scene.ply", tmp_path / "page.html"
    assert_refused(run("view", scene, tmp_path / "no.ply", "-o", page_file), "no.ply")
    assert_refused(run("view", scene, "-o", tmp_path / "none" / "page.html"), "none")
    assert_refused(run("view", scene, "-o", page_file, "--cameras", "oribt"), "oribt")
    assert not page_file.exists()


def test_without_the_viewer_an_error_says_how_to_install_it(files, tmp_path):
    package = tmp_path / "src" / "nanogs"
    source = Path(nanogs.__file__).parent
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__", "viewer.js"))
    environment = {**os.environ, "PYTHONPATH": str(package.parent)}
    result = run("view", files / "scene.ply", "-o", tmp_path / "page.html", env=environment)
    assert_refused(result, "without the viewer", "pip install", "NANOGS_NO_VIEWER")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="the browser is a shell script")
def test_a_browser_is_opened_on_request_only(files, tmp_path):
    require_bundle()
    browser, log = tmp_path / "browser", tmp_path / "seen"
    browser.write_text(f'#!/bin/sh\necho "$1" >> {log}\n')
    browser.chmod(browser.stat().st_mode | stat.S_IXUSR)
    environment = {**os.environ, "BROWSER": str(browser), "DISPLAY": ":0"}
    page_file = tmp_path / "page.html"
    arguments = ("view", files / "scene.ply", "-o", page_file, "-w")
    assert (
        run(*arguments, env=environment).returncode == 0
    )  # not opened, because this is no terminal
    assert not log.exists()
    assert run(*arguments, "--open", env=environment).returncode == 0
    assert log.read_text().strip() == page_file.as_uri()


def test_view_files_reports_its_stages_and_times(files, tmp_path):
    require_bundle()
    steps = []
    inputs = [("a", files / "scene.ply"), ("b", files / "small.compressed.ply")]
    report = view_files(
        inputs, tmp_path / "p.html", views=1, width=32, height=32, progress=steps.append
    )
    stages = list(dict.fromkeys(step.stage for step in steps))
    assert stages == ["read", "cameras", "render", "score", "encode", "write"]
    assert set(report.seconds) == {"read", "cameras", "measure", "pack", "write"}
    assert report.models[1].page_bytes < report.models[0].page_bytes
