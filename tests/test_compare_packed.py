"""Comparing models, and each of them packed in other formats (`packed`)."""

import json
import math

import numpy as np
import pytest

import nanogs
from builders import random_splats
from launch import run
from nanogs.errors import FormatError, NotEnoughMemoryError
from nanogs.formatting import number_text
from nanogs.io.parts import FileSource
from nanogs.memory import LIBRARIES
from nanogs.scoring.run import compare_files
from nanogs.views.automatic import automatic_cameras
from test_bench import write_photographs
from test_cli import assert_refused
from viewer_bundle import require_bundle
from views_and_scores import mean_psnr_ssim

FORMATS = [".sog", ".spz"]
SMALL = {"views": 3, "pixels": 64}
WORDS_OF_VIEWS = "dB on 8 held-out views of 512 pixels"
WORDS = ("--views", "3", "--pixels", "64")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """An original, two smaller models of it, and a packed one."""
    folder = tmp_path_factory.mktemp("beside")
    splats = random_splats(600, degree=2)
    nanogs.save(splats, folder / "scene.ply")
    nanogs.save(splats.take(np.arange(0, 600, 2)), folder / "half.ply")
    nanogs.save(splats.take(np.arange(0, 600, 3)).with_sh_degree(0), folder / "third.ply")
    nanogs.save(splats.take(np.arange(0, 600, 2)), folder / "half.spz")
    return folder


def test_scores_equal_those_of_files_saved_and_loaded_by_hand(files, tmp_path, temporary):
    scene, models = files / "scene.ply", [files / "half.ply", files / "third.ply"]
    found = nanogs.compare(scene, *models, packed=FORMATS, **SMALL).models
    original = nanogs.load(scene)
    cameras = automatic_cameras(original, 3, width=64, height=64, split="test")
    assert [one.name for one in found] == [
        f"{path.name}{more}" for path in models for more in ("", " as .sog", " as .spz")
    ]
    for path, (unpacked_row, *packed) in zip(models, (found[:3], found[3:]), strict=True):
        whole = nanogs.load(path)
        unpacked = mean_psnr_ssim(original, whole, cameras)
        assert (unpacked_row.packed, unpacked_row.psnr) == (None, pytest.approx(unpacked[0]))
        for suffix, one in zip(FORMATS, packed, strict=True):
            nanogs.save(whole, tmp_path / f"saved{suffix}", overwrite=True)
            loaded = nanogs.load(tmp_path / f"saved{suffix}")
            expected = mean_psnr_ssim(original, loaded, cameras)
            assert [one.psnr, one.ssim] == pytest.approx(expected)
            assert one.file_bytes == (tmp_path / f"saved{suffix}").stat().st_size
            loss = one.packed
            assert (loss.format, loss.of) == (suffix, path.name)
            assert loss.psnr_cost == pytest.approx(unpacked[0] - expected[0])
            assert loss.ssim_cost == pytest.approx(unpacked[1] - expected[1])
            assert [loss.psnr, loss.ssim] == pytest.approx(mean_psnr_ssim(whole, loaded, cameras))


def test_packed_models_are_scored_at_every_size_of_views(files, temporary):
    pair = (files / "scene.ply", files / "half.ply")
    both = nanogs.compare(*pair, packed=[".spz"], views=2, pixels=[32, 64])
    for pixels, one in zip((32, 64), both.each, strict=True):
        alone = nanogs.compare(*pair, packed=[".spz"], views=2, pixels=pixels)
        assert one.models == alone.models
    assert both.models[1].packed != both.further[0].models[1].packed


def test_models_and_sources_are_packed_like_files(files, temporary):
    paths = (files / "scene.ply", files / "half.ply")
    expected = nanogs.compare(*paths, packed=[".sog"], **SMALL).models[1]
    found = nanogs.compare(*map(nanogs.load, paths), packed=["sog"], **SMALL).models[1]
    assert (found.name, found.packed.of) == ("model 1 as .sog", "model 1")
    assert (found.file_bytes, found.psnr) == (expected.file_bytes, expected.psnr)
    assert str(nanogs.compare(*paths, packed=[".sog"], **SMALL)).endswith(
        f"packing alone costs {number_text(expected.packed.psnr_cost)} dB"
    )


def test_little_memory_gives_the_same_scores(files, temporary, monkeypatch):
    pair = (files / "scene.ply", files / "half.ply")
    expected = nanogs.compare(*pair, packed=[".spz"], **SMALL)
    monkeypatch.setattr("nanogs.scoring.needed.needed_bytes", lambda *_, **__: 10**15)
    monkeypatch.setattr(FileSource, "load", None)  # no model is loaded whole
    assert nanogs.compare(*pair, packed=[".spz"], max_memory="1GB", **SMALL) == expected
    with pytest.raises(NotEnoughMemoryError):
        nanogs.compare(*pair, packed=[".spz"], max_memory=LIBRARIES + 1000, **SMALL)


def test_a_model_already_packed_is_noted_and_not_packed_again(files, temporary):
    pair = (files / "scene.ply", files / "half.spz")
    found = nanogs.compare(*pair, packed=FORMATS, **SMALL)
    assert [model.name for model in found.models] == ["half.spz", "half.spz as .sog"]
    already, itself = (note for note in found.notes if note.startswith("half.spz: the file is "))
    assert "already packed as .spz and is not packed again" in already
    assert "itself packed, as .spz" in itself
    [plain] = nanogs.compare(*[files / "scene.ply"] * 2, packed=[".ply"], **SMALL).notes
    assert plain == "scene.ply: the file is already a .ply file, and is not written as one again."
    alone = nanogs.compare(*pair, packed=[".spz"], **SMALL)
    assert [model.name for model in alone.models] == ["half.spz"]
    assert len([note for note in alone.notes if "packed" in note]) == 1


def test_packing_a_copy_of_the_original_costs_infinite_decibels(files, temporary):
    scene = files / "scene.ply"
    _, packed = nanogs.compare(scene, scene, packed=[".sog"], **SMALL).models
    assert packed.packed.psnr_cost == math.inf
    assert packed.packed.psnr == packed.psnr < math.inf
    nothing = nanogs.compare(scene, scene, packed=[".npz"], **SMALL).models[1].packed
    assert (nothing.psnr_cost, nothing.ssim_cost, nothing.psnr) == (0, 0, math.inf)
    assert packed.packed.text == "the loss is packing alone"


def test_packing_that_restores_the_original_gains_infinite_decibels(files, temporary):
    """Packing rounds the model to the original itself."""
    found = nanogs.compare(files / "half.spz", files / "half.ply", packed=[".spz"], **SMALL)
    model, packed = found.models
    assert (model.psnr < math.inf, packed.psnr) == (True, math.inf)
    assert packed.packed.psnr_cost == -math.inf
    assert packed.packed.text == "packing alone costs -∞ dB"
    assert packed.packed.psnr == model.psnr


def test_packed_models_are_scored_against_photographs(files, tmp_path, temporary):
    scene = files / "scene.ply"
    write_photographs(tmp_path / "photos", scene)
    found = compare_files(
        ("all", scene), [("half", files / "half.ply")], photos=tmp_path / "photos", packed=[".sog"]
    )
    _, half, packed = found.models
    assert [model.name for model in found.models] == ["all", "half", "half as .sog"]
    assert packed.packed.of == "half"
    assert packed.packed.psnr_cost == half.psnr - packed.psnr
    assert packed.packed.psnr > packed.psnr


# ---- what simplify measures -----------------------------------------------------------------


@pytest.mark.usefixtures("small_pictures")  # of 128 pixels
@pytest.mark.parametrize(
    "options", [{}, {"frame": ("rdf", "rub")}, {"format_options": {"bits": 5}}]
)
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_measured_result_reports_the_cost_of_packing(files, tmp_path, suffix, options):
    scene, target = files / "scene.ply", {"ratio": 0.3, "preset": "fast"}
    found = nanogs.simplify_blocks(
        scene, tmp_path / f"a{suffix}", measured=True, **target, **options
    )
    plain = nanogs.simplify_blocks(scene, tmp_path / "a.ply", measured=True, **target)
    assert plain.packed is None
    unpacked, packed = nanogs.compare(
        scene, tmp_path / "a.ply", packed=[suffix], format_options=options.get("format_options"),
        pixels=128,
    ).models  # fmt: skip
    assert (unpacked.psnr, unpacked.ssim) == (plain.judged.psnr, plain.judged.ssim)
    psnr_tolerance = {"abs": 0.3} if "frame" in options else {}  # rounding differs there
    expected, loss = packed.packed, found.packed
    assert loss.format == suffix
    assert found.judged.psnr == pytest.approx(packed.psnr, **psnr_tolerance)
    ssim_tolerance = {"abs": 0.005 if "frame" in options else 1e-6}
    assert found.judged.ssim == pytest.approx(packed.ssim, **ssim_tolerance)
    assert loss.ssim == pytest.approx(expected.ssim, **ssim_tolerance)
    assert loss.ssim_cost == pytest.approx(expected.ssim_cost, **ssim_tolerance)
    assert loss.psnr_cost == pytest.approx(expected.psnr_cost, **psnr_tolerance)
    assert loss.psnr == pytest.approx(expected.psnr, **(psnr_tolerance and {"abs": 3}))
    assert loss.psnr_cost == pytest.approx(plain.judged.psnr - found.judged.psnr, abs=1e-3)


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.parametrize("suffix", [".rad", ".usda"])
def test_the_cost_of_packing_is_reported_for_formats_that_round(files, tmp_path, suffix):
    report = nanogs.simplify_blocks(
        files / "scene.ply", tmp_path / f"a{suffix}", ratio=0.3, preset="fast", measured=True
    )
    assert (report.packed is not None) == (suffix == ".rad")


def test_the_command_simplify_shows_the_cost_of_packing(files, tmp_path):
    arguments = ("simplify", files / "scene.ply", tmp_path / "a.spz", "--ratio", "0.3")
    arguments += ("--preset", "fast")
    shown = run(*arguments, "--measure")
    assert shown.returncode == 0, shown.stderr
    [report] = [json.loads(run(*arguments, "-w", "--measure", "--json").stdout)]
    cost = number_text(report["packed"]["psnr_cost"])
    assert f"{WORDS_OF_VIEWS}, packing alone costs {cost} dB, " in shown.stderr
    assert json.loads(run(*arguments, "-w", "--json").stdout)["packed"] is None


# ---- the command ----------------------------------------------------------------------------


def test_the_command_compare_shows_the_numbers_of_the_library(files, temporary):
    pair = (files / "scene.ply", files / "half.ply")
    arguments = ("compare", *pair, *WORDS, "--packed", ".sog,spz", "--bits", "6")
    found = nanogs.compare(*pair, packed=FORMATS, format_options={"bits": 6}, **SMALL)
    assert json.loads(run(*arguments, "--json").stdout) == json.loads(json.dumps(found.to_dict()))
    shown = run(*arguments)
    assert shown.returncode == 0, shown.stderr
    rows = shown.stdout.splitlines()
    for model in found.models[1:]:
        main, packed_row = (row for row in rows if row.startswith(model.name))
        assert f"{model.psnr:.2f}" in main.split()
        cells = [model.file_bytes / model.splats, model.packed.psnr_cost, model.packed.ssim_cost]
        cells += [model.packed.psnr, model.packed.ssim]
        texts = [number_text(cell, digits) for cell, digits in zip(cells, (1, 2, 4, 2, 4))]  # noqa: B905
        assert packed_row.removeprefix(model.name).split() == texts
    assert "which is what packing alone costs; to model: PSNR of the file against" in shown.stderr
    assert "packing" not in run("compare", *pair, *WORDS).stderr


def test_wrong_options_are_refused_in_one_sentence(files, temporary):
    pair = (files / "scene.ply", files / "half.ply")
    refused = {
        ("--packed", ".html"): "does not read .html",
        ("--packed", ".sgo"): "did you mean '.sog'",
        ("--packed", ","): "--packed names no format",
        ("--packed", ".splat", "--palette", "9"): "--palette is for .",
        ("--palette", "9"): "--palette works only with --packed",
        ("--packed", ".spz", "--cameras", "no.json"): "no.json",
    }
    for more, words in refused.items():
        assert_refused(run("compare", *pair, *WORDS, *more), words)


def test_a_damaged_file_leaves_no_temporary_files(files, tmp_path, temporary):
    (tmp_path / "short.ply").write_bytes((files / "half.ply").read_bytes()[:-40])
    with pytest.raises(FormatError, match="cut short"):
        nanogs.compare(files / "scene.ply", tmp_path / "short.ply", packed=[".sog"], **SMALL)


def test_the_page_shows_the_cost_of_packing(files, tmp_path, temporary):
    require_bundle()
    page = tmp_path / "page.html"
    arguments = ("compare", files / "scene.ply", files / "half.ply", *WORDS, "--packed", ".sog")
    result = run(*arguments, "--report", page, "--json")
    assert result.returncode == 0, result.stderr
    _, packed = json.loads(result.stdout)["models"]
    text = page.read_text(encoding="utf-8")
    loss = packed["packed"]
    assert f'<td data-is="costs (dB)">{loss["psnr_cost"]:.2f}</td>' in text
    assert f'<td data-is="to model (dB)">{loss["psnr"]:.2f}</td>' in text
    assert text.count('data-name="half.ply as .sog"') == 3  # one picture for each view
    assert text.count('id="nanogs-model-') == 2  # only the given models are interactive
    assert "half.ply on the right" in text
    result = run(*arguments[:-2], "--report", page, "-w", "--json")
    assert "costs (dB)" not in page.read_text(encoding="utf-8")
