"""`nanogs.compare` with photographs gives the scores of the command."""

import numpy as np
import pytest

import nanogs
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import OptionError
from nanogs.scoring.run import compare_files
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


def test_the_background_can_be_given(folder):
    paths = [folder / "scene.ply", folder / "small.ply"]
    over_black = nanogs.compare(*paths, photos=folder / "data", background=(0, 0, 0))
    assert over_black.protocol.background == (0.0, 0.0, 0.0)


def test_little_memory_gives_the_same_scores(folder, monkeypatch):
    paths = [folder / "scene.ply", folder / "small.ply"]
    in_memory = nanogs.compare(*paths, photos=folder / "data")
    monkeypatch.setattr("nanogs.scoring.measure.room_for_comparison", lambda *_, **__: 10_000_000)
    streamed = nanogs.compare(*paths, photos=folder / "data")
    assert [model.views for model in in_memory.models] == [model.views for model in streamed.models]


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
