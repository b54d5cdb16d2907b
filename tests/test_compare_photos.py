"""`nanogs.compare` with photographs gives the scores of the command."""

import json
import shutil

import numpy as np
import pytest

import nanogs
from dataset_files import write_capture
from nanogs.bench.scenes import BenchScene, scene_views
from nanogs.bench.settings import BenchSettings
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.memory import LIBRARIES
from nanogs.scoring.modes import render_findings
from nanogs.scoring.needed import needed_bytes
from nanogs.scoring.photos import photographs, photographs_remedy
from nanogs.scoring.run import compare_files
from nanogs.scoring.view_sets import Photographs
from test_bench import write_photographs
from viewer_bundle import require_bundle


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model, a smaller one, and photographs of the first."""
    path = tmp_path_factory.mktemp("photographs")
    scene = make_scene(400)
    nanogs.save(scene, path / "scene.ply")
    nanogs.save(scene.take(np.arange(0, 400, 2)), path / "small.ply")
    write_photographs(path / "data", path / "scene.ply")
    return path


def test_compare_returns_the_scores_of_the_command(folder):
    paths = [folder / "scene.ply", folder / "small.ply"]
    comparison = nanogs.compare(*paths, photos=folder / "data", packed=".sog")
    names = [(path.name, path) for path in paths]
    expected = compare_files(names[0], names[1:], photos=folder / "data", packed=(".sog",))
    assert comparison == expected
    assert [model.name for model in comparison.models] == [
        "scene.ply",
        "small.ply",
        "small.ply as .sog",
    ]
    assert comparison.protocol.kind == "photographs"
    assert comparison.protocol.background == (1.0, 1.0, 1.0), "the data set's own"
    assert comparison.models[0].psnr > 45, "photographs of the model itself, in 8 bits"
    assert comparison.models[1].psnr < 40


@pytest.mark.parametrize(
    ("tests", "on_the_right"), [(["small"], "small"), (["small", "less"], "one of the others")]
)
def test_the_page_names_what_its_3d_view_shows_beside_the_original(
    folder, tmp_path, tests, on_the_right
):
    """The original is in the table of photographs, and still on the left in 3D."""
    require_bundle()
    page = tmp_path / "page.html"
    small = [(name, folder / "small.ply") for name in tests]
    scene = ("scene", folder / "scene.ply")
    compare_files(scene, small, photos=folder / "data", report=page, interactive=True)
    text = page.read_text("utf-8")
    assert f"The original is on the left, {on_the_right} on the right." in text
    assert "Against <b>data</b> (photographs)" in text
    assert str(folder) not in text


def test_masks_that_are_ignored_are_noted(folder):
    data = folder / "masked"
    shutil.copytree(folder / "data", data)
    cameras = json.loads((data / "transforms_test.json").read_text())
    cameras["frames"][0]["mask_path"] = "mask.png"
    (data / "transforms_test.json").write_text(json.dumps(cameras))
    small = folder / "small.ply"
    (note,) = nanogs.compare(small, small, photos=data).notes
    assert note.startswith("The masks of 1 photograph (mask_path) are ignored")
    assert render_findings(small, Photographs(data)).notes == (note,)
    views = scene_views(BenchScene("a", small, data), nanogs.load(small), BenchSettings())
    assert note in views.notes


def test_the_background_can_be_given(folder):
    paths = [folder / "scene.ply", folder / "small.ply"]
    over_black = nanogs.compare(*paths, photos=folder / "data", background=(0, 0, 0))
    assert over_black.protocol.background == (0.0, 0.0, 0.0)


def test_little_memory_gives_the_same_scores(folder, monkeypatch):
    paths = [folder / "scene.ply", folder / "small.ply"]
    in_memory = nanogs.compare(*paths, photos=folder / "data")
    monkeypatch.setattr("nanogs.scoring.measure.budget_for_comparison", lambda *_, **__: 10_000_000)
    streamed = nanogs.compare(*paths, photos=folder / "data")
    assert [model.views for model in in_memory.models] == [model.views for model in streamed.models]


@pytest.mark.parametrize("packed", [False, True])
def test_models_and_photographs_must_fit_in_memory_together(folder, packed):
    model = nanogs.load(folder / "small.ply")
    photographs = 2 * 32 * 32 * 3 * 4 * (1 + packed)  # the renders of unpacked models are kept too
    fitting = LIBRARIES + needed_bytes([model] * 2, 32 * 32, 1, all_of_it=True) + photographs
    options = {"photos": folder / "data", "packed": [".spz"] if packed else []}
    with pytest.raises(NotEnoughMemoryError, match="use smaller photographs, or a smaller model"):
        nanogs.compare(model, model, **options, max_memory=fitting - 1)
    if not packed:  # else the packed file is read too
        assert nanogs.compare(model, model, **options, max_memory=fitting).models


def test_smaller_photographs_are_named_only_where_they_can_be_chosen(folder, tmp_path):
    write_capture(tmp_path)
    assert "`images=" in photographs_remedy(photographs(tmp_path, None, "test", None))
    assert "`images=" not in photographs_remedy(photographs(folder / "data", None, "test", None))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"views": 3}, "views of their own"),
        ({"cameras": "roam"}, "views of their own"),
        ({"pixels": 64}, "views of their own"),
        ({"up": (0, 1, 0)}, "views of their own"),
        ({"up": np.array([0, 1, 0])}, "views of their own"),
        ({"pixels": np.array([64, 48])}, "views of their own"),
        ({"split": "val"}, "test or train"),
        ({"split": "train"}, "has no train split"),
        ({"photos": None, "images": "images_4"}, "only with photographs"),
        ({"photos": None, "split": "train"}, "only with photographs"),
    ],
)
def test_options_without_effect_are_refused(folder, options, message):
    path = folder / "scene.ply"
    with pytest.raises(nanogs.NanogsError, match=message) as refused:
        nanogs.compare(path, path, **({"photos": folder / "data"} | options))
    assert isinstance(refused.value, OptionError) or options["split"] == "train"
