"""A running studio: events to the page, saved files, cancelling, and shutting down."""

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

import nanogs
from builders import cloud_pair
from launch import contents, run, run_here
from nanogs.studio import server
from studio import running

FAST = {"preset": "fast"}
posix = pytest.mark.skipif(os.name == "nt", reason="Windows has other signals")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studio")
    nanogs.save(cloud_pair(4000)[0], folder / "scene.ply")
    return folder


@pytest.fixture(scope="module")
def studio(folder):
    with running("scene.ply", "--idle", 0, cwd=folder) as started:
        yield started


@pytest.fixture
def page(studio):
    page = studio.page()
    page.scene = page.wait("scene")
    yield page
    page.close()


def loaded(page, event, tmp_path):
    path = tmp_path / "model.spz"
    path.write_bytes(page.model(event["model"]["id"]))
    return nanogs.load(path)


def worker_of(studio):
    [found] = [
        child
        for child in psutil.Process(studio.process.pid).children()
        if "resource_tracker" not in " ".join(child.cmdline())
    ]
    return found


def test_a_page_receives_the_facts_of_the_scene(page, tmp_path):
    scene = page.scene
    assert (scene["name"], scene["stem"], scene["splats"]) == ("scene.ply", "scene", 4000)
    assert scene["sh_degree"] == 1
    assert (scene["render_mode"], scene["up"], scene["available"]) == ("default", "-y", 4000)
    assert scene["first"] == {"preset": "default"}
    assert {".ply", ".sog", ".spz"} <= set(scene["formats"])
    assert {"lod-meta.json", ".ssog", "tileset.json", ".rad"} == {
        layout["suffix"] for layout in scene["layouts"]
    }
    shown = loaded(page, scene, tmp_path)
    assert len(shown) == scene["model"]["splats"] == 4000
    scale, centre = scene["page"]["scale"], np.array(scene["page"]["centre"])
    low = (np.array(scene["bounds"]["low"]) - centre) * scale
    assert np.abs(shown.means.min(axis=0) - low).max() < 0.01


def test_a_count_gets_a_draft_and_then_a_measured_result(page, folder, tmp_path):
    number, command = page.ask(wish={"splats": 500}, **FAST)
    assert command == "nanogs simplify scene.ply out.ply --count 500 --preset fast"
    draft = page.wait("draft", number=number)
    assert (draft["splats"], draft["about"]) == (500, True)
    assert len(loaded(page, draft, tmp_path)) == 500
    measured = page.wait("measured", number=number)
    small = tmp_path / "small.ply"
    run("simplify", folder / "scene.ply", small, "--count", 500, "--preset", "fast")
    found = nanogs.compare(folder / "scene.ply", small).models[0]
    assert measured["bytes"] == small.stat().st_size == draft["bytes"]
    assert measured["psnr"] == found.psnr
    assert measured["ssim"] == found.ssim
    assert measured["stop"] == "target"


def coarse_points(page):
    """Return PSNR by count of the coarse points that a page received, some on connecting."""
    points = [event for event in page.seen if event["type"] == "point"]
    return {point["splats"]: point["psnr"] for point in points if point["kind"] == "coarse"}


def test_the_plot_gets_points_while_no_request_runs(page):
    number, _ = page.ask(wish={"splats": 700}, **FAST)
    page.wait("measured", number=number)
    until = time.monotonic() + 60
    while len(points := coarse_points(page)) < 6:
        page.wait("point", seconds=until - time.monotonic())
    assert sorted(points) == [40, 80, 200, 400, 800, 2000]
    assert sorted(points.values()) == [points[count] for count in sorted(points)]
    page.wait("explored")


def test_a_size_and_a_psnr_are_met_by_finding_a_count(page):
    number, command = page.ask(wish={"bytes": 60_000}, **FAST)
    assert "--size 60000" in command
    measured = page.wait("measured", number=number)
    assert 0.9 * 60_000 < measured["bytes"] <= 60_000
    number, command = page.ask(wish={"psnr": 25}, **FAST)
    assert "--psnr 25" in command
    assert abs(page.wait("measured", number=number)["psnr"] - 25) < 1


def test_filters_report_the_removed_splats_and_the_scene_lacks_them(page, folder, tmp_path):
    filters = {"box": [-1, -1, -1, 0.5, 1, 1], "min_opacity": 0.5, "floaters": True}
    number, command = page.ask(wish={"splats": 300}, filters=filters, **FAST)
    filtered = page.wait("filtered", number=number)
    report = nanogs.simplify_blocks(
        folder / "scene.ply", tmp_path / "a.ply", count=300, preset="fast",
        filters=[
            nanogs.filters.box([-1, -1, -1], [0.5, 1, 1]), nanogs.filters.opaque_enough(0.5),
            nanogs.filters.in_company(),
        ],
    )  # fmt: skip
    reported = [(each["name"], each["removed"], each["left"]) for each in filtered["took"]]
    assert reported == [(each.name, each.removed, each.left) for each in report.filters]
    assert not filtered["preview"]
    shown = loaded(page, filtered, tmp_path)
    assert len(shown) == filtered["left"] < 4000
    assert not magenta(shown).any()
    assert "--crop box:-1,-1,-1,0.5,1,1 --min-opacity 0.5 --drop-floaters" in command
    page.wait("measured", number=number)
    number, _ = page.ask(wish={"splats": 300}, **FAST)
    restored = page.wait("filtered", number=number)
    assert (restored["took"], restored["left"]) == ([], 4000)
    assert len(loaded(page, restored, tmp_path)) == 4000
    page.wait("measured", number=number)


def magenta(shown):
    return (shown.sh[:, 0, 1] < -1.5) & (shown.sh[:, 0, [0, 2]] > 1.5).all(axis=1)


def test_each_page_shows_the_scene_with_its_own_filters(page):
    filters = {"min_opacity": 0.5}
    number, _ = page.ask(wish={"splats": 300}, filters=filters, **FAST)
    left = page.wait("filtered", number=number)["left"]
    page.wait("draft", number=number)
    other = page.studio.page()
    number, _ = other.ask(wish={"splats": 200}, filters=filters, **FAST)  # filtered already
    assert other.wait("filtered", number=number)["left"] == left
    other.wait("draft", number=number)
    other.close()
    number, _ = page.ask(wish={"splats": 300}, **FAST)
    assert page.wait("filtered", number=number)["left"] == 4000


def test_filters_can_be_previewed_without_being_applied(page, tmp_path):
    number, _ = page.ask(wish={"splats": 300}, **FAST)
    page.wait("measured", number=number)
    choice = {"wish": {"splats": 300}, "filters": {"min_opacity": 0.9}} | FAST
    page.number += 1
    assert page.post("filter", number=page.number, choice=choice) == (200, {})
    filtered = page.wait("filtered", number=page.number)
    assert filtered["preview"]
    assert [each["name"] for each in filtered["took"]] == ["min-opacity"]
    assert 0 < filtered["left"] < 4000
    shown = loaded(page, filtered, tmp_path)
    assert len(shown) == 4000
    assert int(magenta(shown).sum()) >= 4000 - filtered["left"]
    number, _ = page.ask(wish={"splats": 301}, **FAST)
    assert page.wait("measured", number=number)["available"] == 4000
    assert not [e for e in page.seen if e["type"] == "filtered" and not e.get("preview")]


def test_a_filter_that_leaves_no_splats_fails_and_the_studio_goes_on(page):
    number, _ = page.ask(wish={"splats": 3}, filters={"box": [90, 90, 90, 91, 91, 91]}, **FAST)
    assert "leaves none" in page.wait("failed", number=number)["message"]
    number, _ = page.ask(wish={"splats": 300}, **FAST)
    page.wait("measured", number=number)


SAVED = [
    ("a.ply", {"wish": {"splats": 300}}),
    ("b.sog", {"wish": {"bytes": 12_000}, "format": ".sog"}),
    ("c.spz", {"wish": {"psnr": 24}, "format": ".spz"}),
    pytest.param("d.ply", {"wish": {"splats": 100}, "up": "+z", "preset": "default"},
                 marks=pytest.mark.slow),
    ("e.glb", {"wish": {"splats": 100}, "up": "+x", "format": ".glb", "sh_degree": 0}),
    ("f.ply", {"wish": {"splats": 90}, "render_mode": "mip",
               "filters": {"box": [-0.1, -1, -1, 1, 1, 1 / 3], "min_opacity": 0.8}}),
    ("g/lod-meta.json", {"wish": {"splats": 9}, "format": "lod-meta.json", "levels": "1,0.25"}),
    ("h.rad", {"wish": {"splats": 9}, "format": ".rad", "levels": "0.5,0.25", "up": "+y"}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "choice"), SAVED, ids=str)
def test_saved_files_equal_those_of_the_shown_command(page, folder, tmp_path, name, choice):
    number, command = page.save(name, **{**FAST, **choice})
    saved = page.wait("saved", number=number)
    assert (saved["path"], saved["command"], saved["replaced"]) == (name, command, False)
    assert saved["short"] is None
    assert "splats" in dict(saved["lines"])
    words = shlex.split(command)
    assert words[:4] == ["nanogs", words[1], "scene.ply", name]
    (tmp_path / "scene.ply").symlink_to(folder / "scene.ply")
    again = run(*words[1:], cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    output = name.partition("/")[0]  # of levels, the whole folder
    mine, theirs = contents(folder / output), contents(tmp_path / output)
    assert mine == theirs
    size = len(theirs) if isinstance(theirs, bytes) else sum(map(len, theirs.values()))
    assert saved["bytes"] == size


def test_a_file_is_replaced_only_if_asked_for(page, folder):
    number, _ = page.save("twice.ply", wish={"splats": 50}, **FAST)
    page.wait("saved", number=number)
    before = (folder / "twice.ply").read_bytes()
    choice = {"wish": {"splats": 40}} | FAST
    status, answer = page.post("save", number=99, choice=choice, path="twice.ply")
    assert status == 409
    assert answer["message"] == "twice.ply exists already; press the button again to replace it."
    assert (folder / "twice.ply").read_bytes() == before
    number, command = page.save("twice.ply", overwrite=True, **choice)
    assert command.endswith("--overwrite")
    assert page.wait("saved", number=number)["replaced"]
    assert len(nanogs.load(folder / "twice.ply")) == 40


def test_the_newest_request_replaces_the_others(page):
    numbers = [page.ask(wish={"splats": 100 + n}, **FAST)[0] for n in range(20)]
    measured = page.wait("measured", number=numbers[-1])
    assert measured["splats"] == 119
    ends = {
        event["number"]: event["type"]
        for event in page.seen
        if event["type"] in ("measured", "cancelled")
    }
    assert sorted(ends) == numbers
    assert list(ends.values()).count("measured") < 10


def test_two_pages_do_not_disturb_each_other(page, studio):
    other = studio.page()
    other.wait("scene")
    one, _ = page.ask(wish={"splats": 210}, **FAST)
    other.ask(wish={"splats": 220}, **FAST)
    other.post("cancel")
    three, _ = other.ask(wish={"splats": 230}, **FAST)
    assert page.wait("measured", number=one)["splats"] == 210
    assert other.wait("measured", number=three)["splats"] == 230
    assert other.name != page.name
    assert not [event for event in page.seen if event.get("splats") in (220, 230)]
    assert not [event for event in page.seen if event["type"] == "cancelled"]
    other.close()


def test_cancelling_a_save_leaves_no_file(page, folder):
    before = sorted(path.name for path in folder.iterdir())
    number, _ = page.save("long.sog", wish={"splats": 3000}, format=".sog", preset="best")
    page.wait("progress", number=number)
    start = time.monotonic()
    assert page.post("cancel")[0] == 204
    event = page.wait("cancelled", number=number)
    assert event["kind"] == "save"
    assert time.monotonic() - start < 15
    assert sorted(path.name for path in folder.iterdir()) == before
    number, _ = page.ask(wish={"splats": 310}, **FAST)
    page.wait("measured", number=number)


def test_the_requests_of_a_page_that_is_left_end_at_once_but_its_save_does_not(page, folder):
    save, _ = page.save("left.ply", wish={"splats": 300}, format=".ply", preset="best")
    page.wait("progress", number=save)
    number, _ = page.ask(wish={"splats": 330}, preset="best")
    assert page.post("leave")[0] == 204
    assert page.wait("cancelled")["number"] == number
    page.wait("saved", number=save)
    assert len(nanogs.load(folder / "left.ply")) == 300


@posix
def test_a_worker_killed_during_a_save_is_reported_and_restarted(page, studio, folder):
    before = sorted(path.name for path in folder.iterdir())
    number, _ = page.save("killed.sog", wish={"splats": 3000}, format=".sog", preset="best")
    page.wait("progress", number=number)
    waiting, _ = page.ask(wish={"splats": 315}, **FAST)
    worker_of(studio).kill()
    failed = page.wait("failed", number=number)
    assert failed["kind"] == "save"
    assert "SIGKILL" in failed["message"]
    assert sorted(path.name for path in folder.iterdir()) == before
    assert page.wait("measured", number=waiting)["splats"] == 315
    number, _ = page.ask(wish={"splats": 320}, **FAST)
    assert page.wait("measured", number=number)["splats"] == 320


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_the_studio_at_once(folder, number):
    with running("scene.ply", "--preset", "fast", cwd=folder) as started:
        page = started.page()
        page.wait("scene")
        page.save("ended.sog", wish={"splats": 3000}, format=".sog", preset="best")
        page.wait("progress")
        children = psutil.Process(started.process.pid).children(recursive=True)
        start = time.monotonic()
        started.process.send_signal(number)
        _, stderr = started.process.communicate(timeout=20)
        assert time.monotonic() - start < 5
        page.close()
        assert started.process.returncode == 128 + number
        assert "Traceback" not in stderr
        assert not psutil.wait_procs(children, timeout=5)[1]
    assert not [path.name for path in folder.iterdir() if "ended" in path.name]
    assert not list(folder.glob(".nanogs*"))


def test_the_studio_ends_some_time_after_the_last_page_closes(folder):
    with running("scene.ply", "--idle", 1, cwd=folder) as started:
        page = started.page()
        page.wait("scene")
        time.sleep(2.5)
        assert started.process.poll() is None
        page.close()
        _, stderr = started.process.communicate(timeout=20)
        assert started.process.returncode == 0
        assert "Traceback" not in stderr


def test_an_unreadable_scene_gives_a_one_line_error(tmp_path):
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    for path in ("bad.ply", "missing.ply", "scene.xyz"):
        result = run("studio", path, "--no-open", cwd=tmp_path)
        assert result.returncode == 2
        assert result.stderr.count("\n") == 1
        assert path in result.stderr


def test_without_the_extra_an_error_says_what_to_install(folder, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert run_here("studio", folder / "scene.ply", "--no-open") == 2
    assert 'pip install "nanogs[studio]"' in capfd.readouterr().err


def test_a_port_in_use_gives_an_error(studio, folder):
    port = studio.url.split(":")[2].split("/")[0]
    result = run("studio", "scene.ply", "--no-open", "--port", port, cwd=folder)
    assert result.returncode == 2
    assert f"Port {port} cannot be used" in result.stderr


@pytest.mark.parametrize(("system", "shared"), [("win32", False), ("linux", True)])
def test_an_address_is_reused_only_where_that_does_not_share_the_port(monkeypatch, system, shared):
    """On Windows a second studio would open the same port, and either might get a request."""
    options = []

    class Recorded(socket.socket):
        def setsockopt(self, *given):
            options.append(given[1])

    monkeypatch.setattr(socket, "socket", Recorded)
    monkeypatch.setattr(sys, "platform", system)
    server._listening(0).close()
    assert (socket.SO_REUSEADDR in options) is shared


def test_help_imports_neither_the_server_nor_numba():
    code = (
        "import sys, json; sys.argv = ['nanogs', 'studio', '--help'];"
        "import nanogs.cli\n"
        "try: nanogs.cli.main()\n"
        "except SystemExit: pass\n"
        "names = ('starlette', 'uvicorn', 'numba', 'numpy', 'asyncio')\n"
        "print(json.dumps([name for name in names if name in sys.modules]))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60
    )
    assert json.loads(result.stdout.splitlines()[-1]) == []
