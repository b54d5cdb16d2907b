"""`--device`: errors and notes about missing devices, and when Warp is imported."""

import importlib.util
import json
import subprocess
import sys
import types

import numpy as np
import pytest

import nanogs
from builders import random_splats
from launch import run_here
from nanogs.card import device
from nanogs.card.device import device_notes, use_device
from nanogs.errors import OptionError
from nanogs.views.streamed import drawable


@pytest.fixture(scope="module")
def splats():
    return random_splats(60)


def without_warp(patch):
    find = importlib.util.find_spec
    patch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "warp" else find(name)
    )


@pytest.fixture
def no_card(monkeypatch):
    monkeypatch.setattr(device, "has_driver", lambda: False)


def error_of(capsys, *arguments):
    """Run the command, which must end with exit code 2, and return its error."""
    assert run_here(*arguments) == 2
    return " ".join(capsys.readouterr().err.split())


def test_a_missing_card_is_refused_before_any_output_is_made(scene, tmp_path, capsys, no_card):
    error = error_of(capsys, "render", scene, tmp_path / "out", "--device", "cuda")
    assert "no graphics card" in error
    assert "--device auto" in error
    assert not (tmp_path / "out").exists()


def test_without_warp_the_error_says_what_to_install(scene, tmp_path, capsys, monkeypatch):
    without_warp(monkeypatch)
    monkeypatch.setattr(device, "has_driver", lambda: True)
    error = error_of(capsys, "render", scene, tmp_path / "out", "--device", "cuda")
    assert 'pip install "nanogs[cuda]"' in error
    with use_device("auto") as used:
        assert used == "cpu"


def test_unknown_devices_are_refused_by_name(scene, capsys):
    error = error_of(capsys, "compare", scene, scene, "--device", "gpu")
    assert "cpu, cuda or auto, not 'gpu'" in error
    with pytest.raises(OptionError, match="not 'tpu'"):
        nanogs.render(scene, device="tpu")


def test_auto_without_a_card_uses_the_cpu_with_a_note(scene, tmp_path, capsys, no_card):
    arguments = ("--pixels", "24", "--json", "-w")
    assert run_here("render", scene, tmp_path / "a.png", *arguments) == 0
    default_report = json.loads(capsys.readouterr().out)
    assert default_report["device"] == "cpu"
    assert not any("CPU" in note for note in default_report["notes"])
    assert run_here("render", scene, tmp_path / "b.png", *arguments, "--device", "auto") == 0
    auto_report = json.loads(capsys.readouterr().out)
    assert auto_report["device"] == "cpu"
    assert any("the CPU did its work" in note for note in auto_report["notes"])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_auto_without_a_card_uses_the_cpu_for_blocks_too(splats, tmp_path, no_card):
    path, out = tmp_path / "a.ply", tmp_path / "b.ply"
    nanogs.save(splats, path)
    report = nanogs.simplify_blocks(path, out, count=9, preset="fast", block=40, device="auto")
    assert report.blocks is not None
    assert any("the CPU did its work" in note for note in report.notes)


def test_the_device_is_released_at_the_end_of_its_context(no_card):
    with use_device("cpu") as outer, use_device(None) as inner:
        assert outer == inner == "cpu"
    assert device.engine_in_use() is None
    assert device_notes("cpu", "cpu") == ()
    assert device_notes("cuda", "cuda, A Card") == ("Pictures were made on cuda, A Card.",)


def test_models_that_do_not_fit_into_memory_cannot_use_the_card(splats):
    token = device._engine.set(types.SimpleNamespace(name="a card"))
    try:
        with pytest.raises(OptionError, match="max_memory"):
            drawable(splats, 10**9)
    finally:
        device._engine.reset(token)


def test_warp_is_not_imported_unless_a_card_is_requested():
    code = (
        "import sys, numpy as np\n"
        "sys.modules['warp'] = None\n"
        "import nanogs, nanogs.raster.rendering, nanogs.fit.api, nanogs.cli.app\n"
        "from nanogs.card.device import use_device\n"
        "with use_device('cpu'): pass\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_python_call_takes_a_device(splats):
    (one,) = nanogs.render(splats, views=1, pixels=16)
    (other,) = nanogs.render(splats, views=1, pixels=16, device="cpu")
    assert np.array_equal(one, other)
