"""Filters, frames, SH degrees and joined files in blocks, compared with files changed before."""

import json

import numpy as np
import pytest

import nanogs
from builders import model_bytes, random_splats
from launch import run
from nanogs import filters
from nanogs.errors import ModelError, OptionError, OutputError
from nanogs.filters import Filter
from nanogs.frames import change_frame
from nanogs.levels_of_detail import write_levels
from nanogs.lod.layout import LodLayout
from nanogs.source import Filtered, Joined

GIVEN = {"preset": "fast", "block": 300, "threads": 1}
KEPT = (filters.box((-1, -1, -0.7), (1, 1, 0.7)), filters.opaque_enough(0.2))
FRAME = ("rdf", "fru")


@pytest.fixture(autouse=True)
def small_pages(monkeypatch):
    """Make pages so small that files have several, and that segments begin within pages."""
    monkeypatch.setattr("nanogs.source.base.PAGE_ROWS", 100)


@pytest.fixture(scope="module", params=[".ply", ".spz", ".npz", ".usda"])
def parts(request, tmp_path_factory):
    """Two files of one scene, the second of a lower SH degree."""
    folder = tmp_path_factory.mktemp("parts")
    models = [random_splats(900, degree=2), random_splats(500, degree=1, seed=3)]
    models[0].means[17] = np.nan if request.param in (".ply", ".npz") else 0.5
    paths = [folder / f"{number}{request.param}" for number in range(2)]
    for model, path in zip(models, paths, strict=True):
        nanogs.save(model, path)
    return paths


@pytest.fixture
def scene(parts, tmp_path):
    """One file with the splats of both parts that the filters keep."""
    path = tmp_path / "scene.ply"
    with Filtered(Joined([nanogs.open(part) for part in parts]), KEPT) as left:
        nanogs.save(left, path)
    return path


def options_for(parts):
    """Return the options for some files: a block must hold a file that is only read whole."""
    return GIVEN if parts[0].suffix != ".usda" else GIVEN | {"block": 900}


def test_filters_give_the_result_of_a_file_filtered_before(parts, scene, tmp_path):
    options = options_for(parts) | {"ratio": 0.3}
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    expected = nanogs.simplify_blocks(scene, one, **options)
    report = nanogs.simplify_blocks(parts, two, filters=KEPT, **options)
    assert model_bytes(nanogs.load(two)) == model_bytes(nanogs.load(one))
    assert report.input_count == expected.input_count == len(nanogs.load(scene))
    assert report.achieved_count == expected.achieved_count
    assert report.blocks.blocks == expected.blocks.blocks
    assert (report.read_count, expected.filters) == (1400, ())
    whole = nanogs.source.Joined([nanogs.open(part) for part in parts]).load()
    assert report.filters == filters.apply(whole, KEPT)[1]


def test_frame_changes_results_as_change_frame_does(parts, tmp_path):
    options = options_for(parts) | {"ratio": 0.3}
    nanogs.simplify_blocks(parts, tmp_path / "one.ply", **options)
    nanogs.simplify_blocks(parts, tmp_path / "two.ply", frame=FRAME, **options)
    turned = change_frame(nanogs.load(tmp_path / "one.ply"), *FRAME)
    assert model_bytes(nanogs.load(tmp_path / "two.ply")) == model_bytes(turned)


def test_sh_degree_gives_the_result_of_a_file_cut_before(parts, scene, tmp_path):
    options = options_for(parts) | {"count": 200}
    cut = tmp_path / "cut.ply"
    nanogs.save(nanogs.load(scene).with_sh_degree(1), cut)
    nanogs.simplify_blocks(cut, tmp_path / "one.ply", **options)
    report = nanogs.simplify_blocks(scene, tmp_path / "two.ply", sh_degree=1, **options)
    assert (tmp_path / "two.ply").read_bytes() == (tmp_path / "one.ply").read_bytes()
    assert any("above degree 1 were dropped" in note for note in report.notes)


@pytest.mark.parametrize("layout", [LodLayout.FILES, LodLayout.TILES])
def test_levels_are_made_of_filtered_splats_and_in_the_new_frame(parts, scene, tmp_path, layout):
    ratios = (0.5, 0.1)
    options = {"preset": "fast", "max_memory": None, "block": options_for(parts)["block"]}
    options |= {"layout": layout, "threads": 1} | (
        {"plain": True, "chunk": 100} if layout is LodLayout.TILES else {}
    )
    frame = FRAME
    if layout is LodLayout.TILES:  # rdf alone, from which their files are turned as .usda files are
        frame = ("rdf" if parts[0].suffix == ".usda" else FRAME[1], "rdf")
    write_levels(scene, tmp_path / "one", ratios, **options)
    write_levels(parts, tmp_path / "two", ratios, filters=KEPT, frame=frame, **options)
    for level in range(2):
        one, two = (read_level(tmp_path / name, layout, level) for name in ("one", "two"))
        assert set(map(bytes, two.means)) == set(map(bytes, change_frame(one, *frame).means))


def read_level(folder, layout, level):
    if layout is LodLayout.FILES:
        return nanogs.load(folder / f"level_{level}.ply")
    return nanogs.load(folder / "tileset.json", level=level)


def test_a_job_is_not_resumed_with_another_filter_or_frame(parts, tmp_path):
    out = tmp_path / "a.ply"
    options = options_for(parts) | {"ratio": 0.3, "resume": True}

    def crash(step):
        if step.stage == "grow":
            raise RuntimeError

    with pytest.raises(RuntimeError):
        nanogs.simplify_blocks(parts, out, filters=KEPT, frame=FRAME, progress=crash, **options)
    changed = (KEPT[0], filters.opaque_enough(0.200001))
    with pytest.raises(OutputError, match=r"differs: the filters\)"):
        nanogs.simplify_blocks(parts, out, filters=changed, frame=FRAME, **options)
    with pytest.raises(OutputError, match=r"differs: `frame`\)"):
        nanogs.simplify_blocks(parts, out, filters=KEPT, **options)
    report = nanogs.simplify_blocks(parts, out, filters=KEPT, frame=FRAME, **options)
    assert report.blocks.resumed > 0
    fresh = tmp_path / "b.ply"
    nanogs.simplify_blocks(parts, fresh, filters=KEPT, frame=FRAME, **options)
    assert fresh.read_bytes() == out.read_bytes()


def test_impossible_options_are_refused_before_work_begins(parts, tmp_path):
    options = options_for(parts) | {"ratio": 0.3}
    out = tmp_path / "a.ply"
    for changes, error, message in (
        ({"filters": [filters.in_company()]}, OptionError, "drop-floaters needs the whole"),
        ({"filters": [Filter("own", "", lambda m: m.means[:, 0] > 0)]}, OptionError, "of nanogs.f"),
        ({"filters": [filters.sphere((99, 0, 0), 1)]}, ModelError, "leaves none of 1,400 splats"),
        ({"frame": ("rdf", "up")}, OptionError, "A frame says"),
        ({"sh_degree": 7}, OptionError, "from 0 to 4, not 7"),
    ):
        with pytest.raises(error, match=message):
            nanogs.simplify_blocks(parts, out, **changes, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_command_gives_the_same_result_as_the_library(tmp_path):
    for number in range(2):
        nanogs.save(random_splats(30_000, degree=3, seed=number), tmp_path / f"{number}.ply")
    parts = [tmp_path / "0.ply", tmp_path / "1.ply"]
    # fmt: off
    words = ["simplify", *parts, tmp_path / "a.ply", "--join", "--ratio", "0.1", "--preset", "fast",
             "--crop", "box:-1,-1,-0.7,1,1,0.7", "--min-opacity", "0.2", "--sh-degree", "2",
             "--frame", "rdf:fru", "--max-memory", "231MB", "--json"]
    # fmt: on
    kept = filters.apply(Joined([nanogs.open(part) for part in parts]).load(), KEPT)
    planned = json.loads(run(*words, "--dry-run").stdout)
    report = json.loads(run(*words).stdout)
    assert report["blocks"]["blocks"] > 1, "the memory should be too little for the whole"
    assert planned["blocks"]["splats"] == report["input_count"] == len(kept[0])
    assert report["read_count"] == 60_000
    assert [entry["left"] for entry in report["filters"]] == [each.left for each in kept[1]]
    assert report["frames"] == list(FRAME)
    nanogs.simplify_blocks(
        parts, tmp_path / "b.ply", ratio=0.1, preset="fast", filters=KEPT, frame=FRAME,
        sh_degree=2, max_memory="231MB",
    )  # fmt: skip
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
