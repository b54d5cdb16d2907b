"""Pictures of a source, some rows at a time: bit for bit those of the model held whole."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare
from nanogs.source import InMemory
from nanogs.splats import RenderMode, concatenate
from nanogs.views import stand_in as standing
from nanogs.views import streamed
from nanogs.views.automatic import automatic_cameras
from nanogs.views.cameras import cameras_for
from nanogs.views.roam import roaming_cameras
from nanogs.views.stand_in import stand_in
from nanogs.views.streamed import Part, Streamed, renderings


class Counted(InMemory):
    """A model whose passes are counted."""

    passes = 0

    def blocks(self, rows=None):
        self.passes += 1
        yield from super().blocks(rows)


def same(some, others):
    some, others = list(some), list(others)
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        for name in ("color", "alpha", "depth"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.drawn, one.skipped, one.notes) == (other.drawn, other.skipped, other.notes)


def held(splats, cameras, **options):
    return list(renderings(prepare(splats), cameras, depth=True, **options))


def read(splats, cameras, budget, **options):
    """The pictures from a source, and how often that was read."""
    source = Counted(splats)
    made = list(renderings(Streamed(source, budget), cameras, depth=True, **options))
    return made, source.passes


@pytest.fixture(scope="module")
def splats():
    """Small and large ones, some twice, so that depths tie, and two that are not finite."""
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
def test_pictures_are_those_of_the_model_held_whole(splats, cameras, budget, rows, monkeypatch):
    monkeypatch.setattr(streamed, "BLOCK_ROWS", rows)
    made, passes = read(splats, cameras, budget, background=(0.2, 0.5, 1.0))
    same(made, held(splats, cameras, background=(0.2, 0.5, 1.0)))
    assert any(each.alpha.any() for each in made)
    assert (passes == 1) == (budget == 10_000_000)


@settings(max_examples=25)
@given(
    st.integers(0, 5), st.integers(1, 300), st.integers(3_000, 200_000), st.integers(1, 90),
    st.integers(1, 90), st.sampled_from(RenderMode),
)  # fmt: skip
def test_any_budget_and_any_blocks_give_the_same_bytes(seed, rows, budget, width, height, mode):
    splats = random_splats(300, degree=1, seed=seed)
    splats = replace(splats, render_mode=mode)
    cameras = automatic_cameras(splats, 2, width=width, height=height)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed, "BLOCK_ROWS", rows)
        try:
            made, _ = read(splats, cameras, budget)
        except NotEnoughMemoryError:
            assert budget < 170 * len(splats)
            return
    same(made, held(splats, cameras))


@pytest.mark.parametrize("kind", ["auto", "roam"])
def test_a_real_scene_is_drawn_alike(kind):
    path = scene_path("guitar.compressed.ply")
    splats = nanogs.load(path)
    find = automatic_cameras if kind == "auto" else roaming_cameras
    cameras = find(splats, 3, width=320, height=200, split="test")
    with nanogs.open(path) as source:
        made = list(renderings(Streamed(source, 4_000_000), cameras, depth=True))
    same(made, held(splats, cameras))


def test_views_share_a_pass_as_far_as_there_is_room(splats, cameras):
    every = [camera for camera in cameras for _ in range(4)]
    made, passes = read(splats, every, 1_000_000)
    assert 1 < passes < len(every)
    same(made, held(splats, every))


def test_what_is_told_never_goes_back_and_ends_with_all(splats, cameras):
    told = []
    read(splats, cameras, 150_000, tell=lambda done, parts: told.append((done, parts)))
    done = [each for each, _ in told]
    assert done == sorted(done)
    assert told[-1] == (len(cameras), len(cameras))


def test_too_many_splats_in_one_tile_are_refused_in_a_sentence():
    dot = random_splats(1, degree=0)
    heap = concatenate([dot] * 500)
    camera = Camera(16, 16, 10.0, 10.0, 8.0, 8.0, np.eye(4), "near")
    camera.world_to_camera[:3, 3] = -heap.means[0] + [0, 0, 3.0]
    with pytest.raises(NotEnoughMemoryError, match=r"view 'near' draws 500 splats.*max_memory"):
        read(heap, [camera], 8_000)
    made, _ = read(heap, [camera], 200_000)
    same(made, held(heap, [camera]))


def test_no_camera_is_no_work_and_a_bad_one_is_refused_before_anything_is_read(splats, cameras):
    source = Counted(splats)
    assert list(renderings(Streamed(source, 10_000), [])) == []
    with pytest.raises(OptionError, match="focal lengths"):
        list(renderings(Streamed(source, 10_000), [replace(cameras[0], fx=-1.0)]))
    assert source.passes == 0


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 90))
def test_parts_cover_the_whole_once(across, down, pieces):
    parts = Part(0, 0, 0, across, down).divided(pieces)
    assert len(parts) >= min(pieces, across * down, 2)
    assert len(parts) > pieces * 0.6 or len(parts) > across * down * 0.6
    seen = np.zeros((down, across), int)
    for part in parts:
        seen[part.top : part.bottom, part.left : part.right] += 1
    assert (seen == 1).all()


@pytest.mark.parametrize("kind", ["auto", "orbit", "inside", "roam"])
def test_a_source_is_looked_at_from_where_the_model_is(splats, kind, monkeypatch):
    monkeypatch.setattr("nanogs.source.base.BLOCK_ROWS", 70)
    monkeypatch.setattr("nanogs.views.occupancy.MAX_SAMPLE", 300)  # of 1,258: one in 5
    monkeypatch.setattr(standing, "LIMIT", 500)
    size = {"count": 4, "width": 64, "height": 48}
    for one, other in zip(
        cameras_for(splats, kind, **size), cameras_for(InMemory(splats), kind, **size), strict=True
    ):
        assert one.world_to_camera.tobytes() == other.world_to_camera.tobytes()
        assert (one.name, one.near, one.fx) == (other.name, other.near, other.fx)


def test_a_stand_in_covers_as_much_as_the_model():
    """Of one in nine splats, each three times as long; below the limit it is the model, bare."""
    splats = random_splats(20_000, degree=1, spread=1.0)
    splats = replace(splats, log_scales=np.full_like(splats.log_scales, np.log(0.015)))
    cameras = automatic_cameras(splats, 2, width=256, height=256)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(standing, "LIMIT", 2_300)
        few = stand_in(splats)
    assert len(few) == -(-20_000 // 9)
    for whole, some in zip(held(splats, cameras), held(few, cameras), strict=True):
        assert some.alpha.mean() == pytest.approx(whole.alpha.mean(), rel=0.1)
    thin = replace(few, log_scales=splats.log_scales[: len(few)])
    assert held(thin, cameras)[0].alpha.mean() < 0.5 * held(splats, cameras)[0].alpha.mean()
    bare = stand_in(splats)
    assert bare.sh_degree == 0
    np.testing.assert_array_equal(bare.log_scales, splats.log_scales)
