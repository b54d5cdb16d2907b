"""Rendering a source some rows at a time: the same pixels as with the whole model in memory."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from dataset_files import trained_camera, write_json
from nanogs.datasets.synthetic import make_scene
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.memory import LIBRARIES
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare
from nanogs.scoring.held_out import held_out
from nanogs.source import InMemory
from nanogs.splats import RenderMode, concatenate
from nanogs.views import covering, streamed
from nanogs.views import decimated as decimation
from nanogs.views.automatic import automatic_cameras
from nanogs.views.cameras import cameras_for
from nanogs.views.decimated import decimated
from nanogs.views.roam import roaming_cameras
from nanogs.views.streamed import Part, Streamed, renderings
from test_free_memory import command


def stderr_line(capsys):
    """Return stderr on one line."""
    return " ".join(capsys.readouterr().err.split())


class Counted(InMemory):
    """A model that counts the rows that are read from it."""

    rows = 0

    def read(self, start, stop):
        self.rows += stop - start
        return super().read(start, stop)


def assert_same(some, others):
    some, others = list(some), list(others)
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        for name in ("color", "alpha", "depth"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.drawn, one.skipped, one.notes) == (other.drawn, other.skipped, other.notes)


def render_whole(splats, cameras, **options):
    return list(renderings(prepare(splats), cameras, depth=True, **options))


def render_streamed(splats, cameras, budget, **options):
    """Return the pictures rendered from a source, and the number of passes over its rows."""
    source = Counted(splats)
    rendered = list(renderings(Streamed(source, budget), cameras, depth=True, **options))
    return rendered, source.rows / len(splats)


@pytest.fixture(scope="module")
def splats():
    """Small and large splats, some twice so that depths tie, and two that are not finite."""
    some = random_splats(900, degree=2, spread=1.0)
    large = random_splats(60, degree=2, seed=1)
    large = replace(large, log_scales=large.log_scales + np.float32(1.5))
    twice = some.take(np.arange(0, 900, 3))
    both = concatenate([some, large, replace(twice, sh=-twice.sh)])
    broken = both.means.copy()
    broken[[5, 77]] = np.nan
    return replace(both, means=broken)


@pytest.fixture(scope="module")
def cameras(splats):
    around = automatic_cameras(splats, 3, width=150, height=70)
    return [*around, replace(around[0].resized(33, 200), name="tall")]


@pytest.mark.parametrize("rows", [100, 1 << 15])
@pytest.mark.parametrize("budget", [120_000, 150_000, 600_000, 10_000_000])
def test_a_source_renders_like_the_whole_model(splats, cameras, budget, rows, monkeypatch):
    monkeypatch.setattr(streamed, "DRAWN_ROWS", rows)
    rendered, passes = render_streamed(splats, cameras, budget, background=(0.2, 0.5, 1.0))
    assert_same(rendered, render_whole(splats, cameras, background=(0.2, 0.5, 1.0)))
    assert any(each.alpha.any() for each in rendered)
    assert (passes == 1) == (budget == 10_000_000)


@settings(max_examples=25)
@given(
    st.integers(0, 5), st.integers(1, 300), st.integers(3_000, 200_000), st.integers(1, 90),
    st.integers(1, 90), st.sampled_from(RenderMode),
)  # fmt: skip
def test_any_budget_and_block_size_render_the_same_pixels(seed, rows, budget, width, height, mode):
    splats = random_splats(300, degree=1, seed=seed)
    splats = replace(splats, render_mode=mode)
    cameras = automatic_cameras(splats, 2, width=width, height=height)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed, "DRAWN_ROWS", rows)
        try:
            made, _ = render_streamed(splats, cameras, budget)
        except NotEnoughMemoryError:
            assert budget < 170 * len(splats)
            return
    assert_same(made, render_whole(splats, cameras))


@pytest.mark.parametrize("kind", ["auto", "roam"])
def test_a_real_scene_renders_like_the_whole_model(kind):
    path = scene_path("guitar.compressed.ply")
    splats = nanogs.load(path)
    find = automatic_cameras if kind == "auto" else roaming_cameras
    cameras = find(splats, 3, width=320, height=200, split="test")
    with nanogs.open(path) as source:
        rendered = list(renderings(Streamed(source, 4_000_000), cameras, depth=True))
    assert_same(rendered, render_whole(splats, cameras))


def test_views_share_a_pass_as_far_as_memory_allows(splats, cameras):
    every = [camera for camera in cameras for _ in range(4)]
    rendered, passes = render_streamed(splats, every, 1_000_000)
    assert 1 < passes < len(every)
    assert_same(rendered, render_whole(splats, every))


def test_progress_never_decreases_and_ends_with_all_views(splats, cameras):
    reported = []
    render_streamed(
        splats,
        cameras,
        150_000,
        on_progress=lambda fractions, parts: reported.append((fractions, parts)),
    )
    fractions = [each for each, _ in reported]
    assert fractions == sorted(fractions)
    assert reported[-1] == (len(cameras), len(cameras))


def test_too_many_splats_in_one_tile_are_refused():
    dot = random_splats(1, degree=0)
    heap = concatenate([dot] * 500)
    camera = Camera(16, 16, 10.0, 10.0, 8.0, 8.0, np.eye(4), "near")
    camera.world_to_camera[:3, 3] = -heap.means[0] + [0, 0, 3.0]
    with pytest.raises(NotEnoughMemoryError, match=r"view 'near' draws 500 splats.*max_memory"):
        render_streamed(heap, [camera], 8_000)
    rendered, _ = render_streamed(heap, [camera], 200_000)
    assert_same(rendered, render_whole(heap, [camera]))


def test_without_cameras_or_with_an_invalid_one_nothing_is_read(splats, cameras):
    source = Counted(splats)
    assert list(renderings(Streamed(source, 10_000), [])) == []
    with pytest.raises(OptionError, match="focal lengths"):
        list(renderings(Streamed(source, 10_000), [replace(cameras[0], fx=-1.0)]))
    assert source.rows == 0


def test_blocks_outside_a_part_of_the_picture_are_not_read_again(splats, cameras, monkeypatch):
    """Rows are sorted from left to right, and the picture is rendered in several parts."""
    monkeypatch.setattr(streamed, "DRAWN_ROWS", 50)
    finite = splats.take(splats.finite() & (splats.log_scales.max(axis=1) < -1.5))
    across = finite.means @ cameras[0].world_to_camera[0, :3]
    ordered = finite.take(np.argsort(across, kind="stable"))
    wide = replace(cameras[0].resized(400, 100), name="wide")
    rendered, once = render_streamed(ordered, [wide], 50_000)
    assert_same(rendered, render_whole(ordered, [wide]))
    mixed, often = render_streamed(finite, [wide], 50_000)
    assert_same(mixed, render_whole(finite, [wide]))
    assert 2 < once < 0.8 * often


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 90))
def test_parts_cover_each_tile_of_the_picture_once(across, down, pieces):
    parts = Part(0, 0, 0, across, down).divided(pieces)
    assert len(parts) >= min(pieces, across * down, 2)
    assert len(parts) > pieces * 0.6 or len(parts) > across * down * 0.6
    seen = np.zeros((down, across), int)
    for part in parts:
        seen[part.top : part.bottom, part.left : part.right] += 1
    assert (seen == 1).all()


@pytest.mark.parametrize("kind", ["auto", "orbit", "inside", "roam"])
def test_a_source_gets_the_same_cameras_as_the_model(splats, kind, monkeypatch):
    monkeypatch.setattr("nanogs.source.base.BLOCK_ROWS", 70)
    monkeypatch.setattr("nanogs.views.occupancy.MAX_SAMPLE", 300)  # of 1,258: one in 5
    monkeypatch.setattr(decimation, "LIMIT", 500)
    size = {"count": 4, "width": 64, "height": 48}
    for one, other in zip(
        cameras_for(splats, kind, **size), cameras_for(InMemory(splats), kind, **size), strict=True
    ):
        assert one.world_to_camera.tobytes() == other.world_to_camera.tobytes()
        assert (one.name, one.near, one.fx) == (other.name, other.near, other.fx)


def test_a_decimated_model_covers_as_much_as_the_model():
    """It has one in nine splats, each three times as long; below the limit all, at degree 0."""
    splats = random_splats(20_000, degree=1, spread=1.0)
    splats = replace(splats, log_scales=np.full_like(splats.log_scales, np.log(0.015)))
    cameras = automatic_cameras(splats, 2, width=256, height=256)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decimation, "LIMIT", 2_300)
        decimated_model = decimated(splats)
    assert len(decimated_model) == -(-20_000 // 9)
    for whole, some in zip(
        render_whole(splats, cameras), render_whole(decimated_model, cameras), strict=True
    ):
        assert some.alpha.mean() == pytest.approx(whole.alpha.mean(), rel=0.1)
    thin = replace(decimated_model, log_scales=splats.log_scales[: len(decimated_model)])
    assert (
        render_whole(thin, cameras)[0].alpha.mean()
        < 0.5 * render_whole(splats, cameras)[0].alpha.mean()
    )
    sample = decimated(splats)
    assert sample.sh_degree == 0
    np.testing.assert_array_equal(sample.log_scales, splats.log_scales)


# ---- compare, held-out views and render in little memory -----------------------------------------


@pytest.fixture
def arena_budgets(monkeypatch):
    """Plan with tiny fixed amounts of memory; return the budgets of all arenas made since."""
    monkeypatch.setattr("nanogs.memory_estimates._STREAMED", 10_000)
    monkeypatch.setattr("nanogs.views.plan.LEAST", 100_000)
    budgets = []

    class Arena(streamed.Arena):
        def __init__(self, budget, *others):
            budgets.append(budget)
            super().__init__(budget, *others)

    monkeypatch.setattr(streamed, "Arena", Arena)
    return budgets


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    scene = make_scene(3000)
    means = scene.means.copy()
    means[7] = np.nan
    nanogs.save(replace(scene, means=means), folder / "scene.ply")
    nanogs.save(scene.take(np.arange(0, 3000, 2)).with_sh_degree(1), folder / "small.ply")
    return [folder / "scene.ply", folder / "small.ply"]


@pytest.mark.parametrize("kind", ["files", "sources", "models"])
def test_a_comparison_has_the_same_numbers_in_little_memory(pair, kind, arena_budgets):
    options = {"cameras": ["auto", "roam"], "pixels": [96, 128], "views": 3}
    expected = nanogs.compare(*pair, **options)
    assert not arena_budgets
    open_model = {"files": str, "sources": nanogs.open, "models": nanogs.load}[kind]
    models, names = [open_model(path) for path in pair], [pair[1].name]
    memory = LIBRARIES + (4_400_000 if kind == "models" else 3_800_000)
    found = nanogs.compare(*models, names=names, max_memory=memory, **options)
    assert len(set(arena_budgets)) == 1
    assert 100_000 < arena_budgets[0] < 1_500_000
    found, expected = found.to_dict(), expected.to_dict()
    for each in (found, expected):
        each.pop("reference")
        for one in (each, *each["further"]):
            one.pop("reference", None)
            for model in one["models"]:
                model.pop("file_bytes")
    assert found == expected


def test_a_comparison_that_cannot_fit_into_memory_is_refused(pair, monkeypatch):
    monkeypatch.setattr("nanogs.views.plan.LEAST", 10**9)
    with pytest.raises(NotEnoughMemoryError, match=r"Comparing these models takes about 1\.\d+ GB"):
        nanogs.compare(*pair, pixels=32, max_memory="211MB")


def test_the_views_of_a_camera_file_count_in_memory(pair, tmp_path):
    cameras = [trained_camera(id=n, img_name=str(n), width=4000, height=4000) for n in range(20)]
    file = write_json(tmp_path / "cameras.json", cameras)
    with pytest.raises(
        NotEnoughMemoryError, match=r"Comparing these models takes about 1\d\.\d+ GB"
    ):
        nanogs.compare(*pair, cameras=str(file), max_memory="2GB")


def test_the_command_compares_in_little_memory(pair, tmp_path, arena_budgets, capsys):
    arguments = ["compare", *pair, "--sizes", "48", "--views", "3", "--json"]
    assert command(*arguments) == 0
    expected = json.loads(capsys.readouterr().out)
    assert not arena_budgets
    assert command(*arguments, "--max-memory", f"{LIBRARIES + 1_500_000}") == 0
    assert arena_budgets
    assert json.loads(capsys.readouterr().out) == expected
    page = tmp_path / "page.html"
    arguments = ["compare", *pair, "--max-memory", f"{LIBRARIES + 1_300_000}", "--views", "2"]
    assert command(*arguments, "--sizes", "48", "--report", page, "--no-interactive", "-q") == 0
    assert page.read_text().count("data:image/") == 6
    interactive = [*arguments, "--sizes", "48", "--report", tmp_path / "b.html"]
    assert command(*interactive) == 2
    assert "or leave the models out of the page (--no-interactive)" in stderr_line(capsys)
    assert not (tmp_path / "b.html").exists()


def test_notes_of_reading_are_the_same_in_little_memory(
    pair, tmp_path, arena_budgets, monkeypatch, capsys
):
    for module in (streamed, covering):
        monkeypatch.setattr(module, "DRAWN_ROWS", 1000)
    nanogs.save(make_scene(3000), tmp_path / "scene.splat")
    rows = np.fromfile(tmp_path / "scene.splat", np.float32).reshape(-1, 8)
    rows[[7, 2900], 3] *= -1
    rows.tofile(tmp_path / "scene.splat")
    note = "2 splats have a negative scale, which became NaN."
    for words in (
        ["compare", tmp_path / "scene.splat", pair[1]],
        ["render", tmp_path / "scene.splat", tmp_path / "a", "-w"],
    ):
        arguments = [*words, "--pixels", "48", "--views", "3"]
        said = []
        for limit in ([], ["--max-memory", f"{LIBRARIES + 800_000}"]):
            assert command(*arguments, *limit) == 0
            said.append([line for line in capsys.readouterr().err.splitlines() if note in line])
            assert bool(arena_budgets) == bool(limit)
        arena_budgets.clear()
        named = "scene.splat: " if words[0] == "compare" else ""
        assert said == [[f"note: {named}{note}"]] * 2


@pytest.mark.parametrize("open_model", [nanogs.open, InMemory])
def test_held_out_views_score_sources_like_models(pair, open_model, arena_budgets):
    splats, small = map(nanogs.load, pair)
    expected = held_out(splats)
    opened = [open_model(path if open_model is nanogs.open else nanogs.load(path)) for path in pair]
    reported = []
    limit = LIBRARIES + 122 * 512**2 * 8
    found = held_out(
        opened[0], lambda done, parts: reported.append((done, parts)), max_memory=limit
    )
    assert reported[-1] == (8, 8)
    assert found.judge(opened[1]) == expected.judge(small)
    assert found.psnr(opened[1]) == expected.psnr(small) == found.psnr(small)
    for one, other in zip(found.views, expected.views, strict=True):
        assert one.image.tobytes() == other.image.tobytes()
    with pytest.raises(NotEnoughMemoryError, match=r"Measuring takes about .*leave out"):
        held_out(opened[0], max_memory=LIBRARIES + 1000)


@pytest.mark.parametrize("open_model", [str, nanogs.open, nanogs.load])
@pytest.mark.parametrize("cameras", ["auto", "roam"])
def test_pictures_are_the_same_in_little_memory(pair, open_model, cameras, arena_budgets):
    options = {"views": 2, "pixels": (100, 80), "transparent": cameras == "roam"}
    expected = nanogs.render(pair[0], cameras, **options)
    assert not arena_budgets
    limit = LIBRARIES + (2_100_000 if open_model is nanogs.load else 1_500_000)
    steps = []
    found = nanogs.render(
        open_model(pair[0]), cameras, max_memory=limit, progress=steps.append, **options
    )
    assert 100_000 < arena_budgets[0] < 1_000_000
    assert steps[-1].fraction == 1
    for one, other in zip(found, expected, strict=True):
        assert one.tobytes() == other.tobytes()
    with pytest.raises(NotEnoughMemoryError, match=r"Rendering .*smaller pictures \(`pixels`\)"):
        nanogs.render(open_model(pair[0]), cameras, max_memory="210MB", **options)


def test_the_command_renders_in_little_memory(pair, tmp_path, arena_budgets, capsys):
    arguments = ["--views", "2", "--pixels", "100x80", "--depth"]
    assert command("render", pair[0], tmp_path / "a", *arguments) == 0
    assert not arena_budgets
    assert "1 splat with a NaN" in stderr_line(capsys)
    limit = LIBRARIES + 1_300_000
    assert command("render", pair[0], tmp_path / "b", *arguments, "--max-memory", str(limit)) == 0
    assert arena_budgets
    assert "1 splat with a NaN" in stderr_line(capsys)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(files) == 4
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert command("render", pair[0], tmp_path / "c", *arguments, "--max-memory", "210MB") == 2
    assert "smaller pictures (--pixels)" in stderr_line(capsys)
    assert not (tmp_path / "c").exists()
