"""The cost of packing alone: a packed model compared with the same model unpacked."""

import json
import tempfile
from dataclasses import asdict

import numpy as np
import pytest

import lccfiles
import nanogs
from builders import random_splats
from ksplatfiles import ksplat, section
from launch import run
from nanogs.errors import ModelError, NotEnoughMemoryError, OptionError
from nanogs.io import registry
from nanogs.io.parts import FileSource
from nanogs.memory import LIBRARIES
from nanogs.scoring.packing import notes_on, write_packed
from nanogs.views.automatic import automatic_cameras
from test_cli import assert_refused
from views_and_scores import mean_psnr_ssim

FORMATS = [".sog", ".spz", ".splat", ".compressed.ply"]
WORDS = "8 held-out views of {} pixels"

small = pytest.mark.usefixtures("small_pictures")  # of 128 pixels


@pytest.fixture(scope="module", params=[0, 2], ids=["plain", "harmonics"])
def scene(request, tmp_path_factory):
    """The file of a model, without and with harmonics."""
    path = tmp_path_factory.mktemp("cost") / "scene.ply"
    nanogs.save(random_splats(400, degree=request.param), path)
    return path


def packed_numbers(scene, folder, suffix, **options):
    """Return bytes, PSNR and SSIM of a file that is saved, loaded and rendered by hand."""
    splats, path = nanogs.load(scene), folder / f"packed{suffix}"
    nanogs.save(splats, path, format_options=options)
    cameras = automatic_cameras(splats, 8, width=128, height=128, split="test")
    return [path.stat().st_size, *mean_psnr_ssim(splats, nanogs.load(path), cameras)]


def numbers(file):
    return [file.file_bytes, file.judged.psnr, file.judged.ssim]


@small
def test_scores_equal_those_of_files_saved_and_loaded_by_hand(scene, tmp_path, temporary):
    cost = nanogs.packing_cost(scene, FORMATS)
    assert [file.format for file in cost.files] == FORMATS
    assert cost.notes == ()
    for file in cost.files:
        assert numbers(file) == pytest.approx(packed_numbers(scene, tmp_path, file.format))
        assert file.judged.protocol.text == WORDS.format(128)
        assert file.splats == 400
        assert file.splat_bytes == file.file_bytes / 400


@small
def test_a_format_gets_the_options_that_it_has(scene, tmp_path, temporary):
    chosen = {"bits": 5, "palette": 9, "spz_version": None}
    sog, spz = nanogs.packing_cost(scene, ["sog", "spz"], format_options=chosen).files
    assert numbers(sog) == pytest.approx(packed_numbers(scene, tmp_path, ".sog", bits=5, palette=9))
    assert numbers(spz) == pytest.approx(packed_numbers(scene, tmp_path, ".spz", bits=5, palette=9))


@small
def test_lossless_formats_cost_nothing(scene, temporary):
    [file] = nanogs.packing_cost(nanogs.load(scene), [".ply"]).files
    assert file.judged.psnr == np.inf
    assert file.judged.ssim == pytest.approx(1)
    assert "∞ dB / 1.0000 of the model unpacked" in file.text


@small
def test_paths_models_and_sources_cost_the_same(scene, temporary):
    formats = [".spz", "meta.json"]
    expected = nanogs.packing_cost(scene, formats)
    assert nanogs.packing_cost(nanogs.load(scene), formats) == expected
    with nanogs.open(scene) as source:
        assert nanogs.packing_cost(source, formats) == expected


@small
def test_little_memory_gives_the_same_scores(scene, temporary, monkeypatch):
    expected = nanogs.packing_cost(scene, [".spz"])
    monkeypatch.setattr("nanogs.scoring.packing_cost.needed_bytes", lambda *_, **__: 10**15)
    monkeypatch.setattr(FileSource, "load", None)  # the model is not loaded whole
    assert nanogs.packing_cost(scene, [".spz"], max_memory="1GB") == expected
    with pytest.raises(NotEnoughMemoryError, match=r"takes about .* raise `max_memory`"):
        nanogs.packing_cost(scene, [".spz"], max_memory=LIBRARIES + 1000)


def test_formats_that_take_too_much_memory_are_refused_before_any_work(
    scene, temporary, monkeypatch
):
    monkeypatch.setattr("nanogs.scoring.packing.convert_bytes", lambda *_, **__: 10**15)
    monkeypatch.setattr(FileSource, "load", None)
    message = r"Packing .*scene\.ply as \.sog takes about"
    with pytest.raises(NotEnoughMemoryError, match=message):
        nanogs.packing_cost(scene, [".sog"])
    with pytest.raises(NotEnoughMemoryError, match=message):
        nanogs.compare(scene, scene, packed=[".sog"])


@pytest.mark.parametrize(
    ("formats", "options", "message"),
    [
        ([], {}, "at least one format"),
        ([".html"], {}, r"does not read \.html files, .*; name another"),
        ([".sgo"], {}, r"did you mean '\.sog'"),
        ([".ksplat"], {}, r"^nanogs does not write a format '\.ksplat'; it writes"),
        (["ksplat"], {}, "^nanogs does not write a format 'ksplat'; it writes"),
        (["lod-meta.json"], {}, "^lod-meta.json describes levels of detail; make them with"),
        (
            [".splat", ".ply"],
            {"palette": 9},
            r"is for \.spz, \.sog and meta\.json files, not for \.splat",
        ),
        ([".splat", ".sog"], {"bits": 99}, "`bits` must be a whole number from 4 to 8, not 99"),
        ([".ply"], {}, r"scene\.ply is already a \.ply file; name another"),
    ],
)
def test_formats_that_cannot_be_measured_are_refused(scene, temporary, formats, options, message):
    with pytest.raises(OptionError, match=message):
        nanogs.packing_cost(scene, formats, format_options=options)


def test_an_invisible_model_leaves_no_temporary_files(temporary):
    unseen = random_splats(9)
    unseen.opacity_logits[:] = -np.inf
    with pytest.raises(ModelError, match="shows nothing"):
        nanogs.packing_cost(unseen, [".sog"])


def test_a_model_that_is_already_packed_is_noted_or_refused(scene, tmp_path, temporary):
    nanogs.save(nanogs.load(scene), tmp_path / "a.splat")
    nanogs.save(nanogs.load(scene), tmp_path / "a" / "meta.json")
    [note] = nanogs.packing_cost(tmp_path / "a.splat", [".spz"]).notes
    assert note.startswith("the file is itself packed, as .splat; ")
    told = run("info", tmp_path / "a.splat", "--packed", "spz", "--json")
    assert f"{tmp_path / 'a.splat'}: {note}" in json.loads(told.stdout)["notes"]
    for packed in ("a", "a/meta.json"):
        with pytest.raises(OptionError, match=r"is already packed as \.sog"):
            nanogs.packing_cost(tmp_path / packed, [".sog"])


WRITTEN = [known.suffix for known in registry.formats() if known.writable and known.readable]


@pytest.mark.parametrize("suffix", WRITTEN)
def test_exactly_the_formats_that_round_values_say_so(tmp_path, suffix):
    model = random_splats(400)
    path = write_packed(model, suffix, {}, tmp_path)
    with nanogs.open(path) as source:
        # Compared in order of size, because some formats have an order of their own.
        both = np.sort([model.opacities(), source.load().opacities()], axis=1)
        rounds = np.abs(both[0] - both[1]).max() > 1e-4
        assert registry.writable(path).rounds == rounds
        assert bool(notes_on(source)) == rounds


def test_files_in_formats_that_are_not_written_are_noted_if_packed(scene, tmp_path):
    """glTF, of which nanogs writes only unpacked files, and formats that it only reads."""
    model = nanogs.load(scene)
    for packed in (True, False):
        folder = tmp_path / str(packed)
        options = {"layout": "3d tiles", "plain": not packed, "preset": "fast"}
        nanogs.write_levels(model, folder, [1.0], **options)
        for name in ("tileset.json", "0_0.glb"):
            with nanogs.open(folder / name) as source:
                assert bool(notes_on(source)) == packed
    [note] = notes_on(nanogs.open(tmp_path / "True" / "0_0.glb"))
    assert note.startswith("the file is itself packed, as .glb; ")
    (tmp_path / "a.ksplat").write_bytes(ksplat(section(4, 0, 0)))
    for name, data in lccfiles.typical_model(np.random.default_rng(3)).items():
        (tmp_path / name).write_bytes(data)
    nanogs.write_levels(model, tmp_path / "s", [1.0], layout="streamed sog", preset="fast")
    for name in ("a.ksplat", "scene.lcc", "s/lod-meta.json"):
        assert notes_on(nanogs.open(tmp_path / name))


def test_progress_is_reported(scene, temporary):
    steps = []
    nanogs.packing_cost(scene, [".spz", ".sog"], progress=steps.append)
    stages = list(dict.fromkeys((step.number, step.stage) for step in steps))
    assert [stage for _, stage in stages] == ["read", "render"] + ["write", "score"] * 2
    assert steps[-1].fraction == 1


# ---- nanogs info ----------------------------------------------------------------------------


def test_info_shows_the_cost_of_packing(scene, temporary):
    cost = nanogs.packing_cost(scene, [".sog", ".spz"], format_options={"bits": 6})
    arguments = ("info", scene, "--packed", ".sog,spz", "--bits", "6")
    shown = run(*arguments)
    assert shown.returncode == 0, shown.stderr
    words = " ".join(shown.stdout.split())  # however lines are broken
    for file in cost.files:
        judged = f"{file.judged.psnr:.2f} dB / {file.judged.ssim:.4f} of the model unpacked"
        size = f"{file.file_bytes / 1e3:.1f} kB, {file.splat_bytes:.1f} bytes a splat"
        assert f"packed as {file.format} {size}; {judged}" in words
    assert f"on {WORDS.format(512)}: PSNR and SSIM of each file, read back" in words
    report = json.loads(run(*arguments, "--json").stdout)
    assert report["packed"] == json.loads(json.dumps([file.to_dict() for file in cost.files]))
    assert report["packed"][0]["judged"] == json.loads(json.dumps(asdict(cost.files[0].judged)))
    assert report["splats"] == 400


def test_info_without_the_option_packs_nothing(scene):
    assert json.loads(run("info", scene, "--json").stdout)["packed"] == []
    assert "packed as" not in run("info", scene).stdout


def test_info_refuses_wrong_options_in_one_sentence(scene):
    refused = {
        (".html",): "does not read .html",
        (".sgo",): "did you mean '.sog'",
        (",",): "--packed names no format",
        ("",): "--packed names no format",
        (".ply",): "scene.ply is already a .ply file; name another format, such as .sog.",
        (".splat", "--palette", "9"): "--palette is for .",
    }
    assert_refused(run("info", scene, "--bits", "6"), "--bits works only with --packed")
    for (formats, *more), words in refused.items():
        assert_refused(run("info", scene, "--packed", formats, *more), words)


def test_info_of_stdin_names_no_temporary_file(scene, tmp_path):
    nanogs.save(nanogs.load(scene), tmp_path / "a.splat")
    data = (tmp_path / "a.splat").read_bytes()
    shown = run("info", "-", "--from", "splat", "--packed", ".spz", data=data)
    assert "packed as .spz" in shown.stdout
    assert "note: stdin: the file is itself packed, as .splat" in shown.stderr
    assert tempfile.gettempdir() not in shown.stdout + shown.stderr
