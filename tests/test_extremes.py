"""Values at the limits of float32: finite input gives finite output of the exact count."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from nanogs.errors import OutputError
from nanogs.io.precision import Precision
from nanogs.lod import tiles
from nanogs.method.activation import scene_origin
from nanogs.method.viewers import estimate_dilation
from nanogs.neighbours import nearest_neighbours
from nanogs.pipeline.options.presets import PRESETS
from nanogs.raster.images import color_image
from nanogs.raster.rendering import render
from nanogs.scoring import scores
from nanogs.splats import RenderMode
from nanogs.views.automatic import automatic_cameras

LARGEST = float(np.finfo(np.float32).max)
HUGE = [0.0, 1e-38, 1e-30, 1e-10, 1.0, 1e8, 1e15, 1e30, LARGEST]
COLUMNS = {  # values that are finite both as stored and when activated
    "means": HUGE,
    "log_scales": [-LARGEST, -1000.0, -100.0, -87.0, -10.0, 0.0, 10.0, 40.0, 88.7],
    "quats": HUGE,
    "opacity_logits": [-LARGEST, -1e3, -90.0, 0.0, 15.0, 40.0, 1e3, LARGEST],
    "sh": HUGE,
}
every_preset = pytest.mark.parametrize("preset", sorted(PRESETS))

pytestmark = pytest.mark.usefixtures("small_views")


def assert_finite(splats):
    for name in COLUMNS:
        assert np.isfinite(getattr(splats, name)).all(), name
    assert splats.finite().all()


@st.composite
def extreme_splats(draw, maximum=24, more=()):
    """Draw a model of ordinary splats with some values at the limits of float32.

    Args:
        draw: Hypothesis' function that draws from a strategy.
        most: Largest number of splats.
        more: Further values that any column may get.
    """
    count = draw(st.integers(2, maximum))
    splats = random_splats(count, degree=draw(st.integers(0, 1)), seed=draw(st.integers(0, 99)))
    for name in draw(st.lists(st.sampled_from(sorted(COLUMNS)), min_size=1, unique=True)):
        column = getattr(splats, name).reshape(-1)
        for _ in range(draw(st.integers(1, 4))):
            value = draw(st.sampled_from([*COLUMNS[name], *more])) * draw(st.sampled_from([1, -1]))
            if more or name != "log_scales" or value < 88.7:
                column[draw(st.integers(0, len(column) - 1))] = value
    return splats


@every_preset
@given(data=st.data())
@settings(max_examples=25)
def test_finite_splats_give_finite_splats_of_the_exact_count(preset, data):
    splats = data.draw(extreme_splats())
    count = data.draw(st.integers(1, len(splats)))
    small, report = nanogs.simplify(splats, count=count, preset=preset)
    assert report.dropped_nonfinite == 0
    assert len(small) == count
    assert_finite(small)


@pytest.mark.filterwarnings("error")
def test_growth_keeps_scales_in_the_range_of_float32():
    """Four opaque splats in one place ask for twice the area of one."""
    splats = random_splats(1, degree=0).take(np.zeros(4, np.int64))
    splats.log_scales[:], splats.opacity_logits[:] = 88.6, 40.0
    for scales in (88.6, [88.6, 0.0, 88.6]):
        splats.log_scales[:] = scales
        small, _ = nanogs.simplify(splats, count=1, preset="fast")
        assert_finite(small)
        assert small.log_scales.max() > 88.6


@every_preset
@pytest.mark.parametrize("count", [2, 3, 4, 40])
@pytest.mark.parametrize("value", [1e30, LARGEST, -LARGEST])
def test_one_huge_sh_coefficient_gives_finite_splats(preset, count, value):
    """Its squared difference overflows float32; a NaN score once made the cut merge too little."""
    splats = random_splats(count)
    splats.sh[0, 0, 0] = value
    small, _ = nanogs.simplify(splats, count=1, preset=preset)
    assert len(small) == 1
    assert_finite(small)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [2, 200])
def test_merges_of_immense_splats_have_finite_errors(count):
    """Their weights exceed float32; infinite errors times balance 0 made a cut read past arrays."""
    splats = random_splats(400, degree=0)
    splats.log_scales[:10] = 85.0
    small, _ = nanogs.simplify(splats, count=count, preset="fast", balance=0.0)
    assert len(small) == count
    assert_finite(small)


@pytest.mark.parametrize("distance", [1e8, 1e15, 1e30])
def test_outliers_do_not_change_pixel_sizes_or_the_scene_origin(distance):
    splats = random_splats(2000)
    means, alphas = splats.means.astype(np.float64), splats.opacities()
    inner = means[9:].copy()
    without_outliers = estimate_dilation(means, alphas, RenderMode.DEFAULT, 512).at(inner)
    means[:5, 0] = distance
    means[5:9] = -distance
    with_outliers = estimate_dilation(means, alphas, RenderMode.DEFAULT, 512).at(inner)
    assert with_outliers == pytest.approx(without_outliers, rel=0.05)
    assert np.abs(scene_origin(means)).max() < 0.2


@every_preset
@pytest.mark.parametrize("distance", [1e8, 1e15])
def test_far_outliers_do_not_change_the_rest(preset, distance):
    """Splats far from the outliers are merged as they would be without them."""
    splats = random_splats(1500, seed=3)
    outliers = replace(random_splats(4, seed=4), render_mode=splats.render_mode)
    outliers.means[:] += np.float32([distance, 0, 0]) * np.float32([[1], [-1], [0.5], [1]])
    joined = nanogs.splats.concatenate([splats, outliers])
    small, _ = nanogs.simplify(joined, ratio=0.2, preset=preset)
    assert_finite(small)
    near = np.abs(small.means).max(axis=1) < 2
    assert np.count_nonzero(~near) <= 8
    without_outliers, _ = nanogs.simplify(splats, count=int(np.count_nonzero(near)), preset=preset)
    areas = [np.sum(m.opacities() * np.exp(2 * m.log_scales.mean(axis=1))) for m in
             (small.take(near), without_outliers)]  # fmt: skip
    assert areas[0] == pytest.approx(areas[1], rel=0.1)


@every_preset
@pytest.mark.parametrize("coordinate", [1.8e38, LARGEST])
def test_a_scene_near_the_float32_maximum_gives_finite_splats(preset, coordinate):
    """The sum of two such centres overflows float32."""
    splats = random_splats(40)
    splats.means[:, 0] = coordinate
    small, report = nanogs.simplify(splats, count=10, preset=preset)
    assert (len(small), report.stop) == (10, "target")
    assert_finite(small)


def test_the_neighbour_search_refuses_nonfinite_centres():
    """The search would read beyond its arrays."""
    means = random_splats(40).means.astype(np.float64)
    means[3, 1] = np.nan
    with pytest.raises(ValueError, match="finite"):
        nearest_neighbours(means, 4)


def test_a_centre_beyond_the_float32_range_counts_as_not_finite():
    splats = random_splats(5)
    far = replace(splats, means=splats.means.astype(np.float64))
    far.means[2, 1] = 1e39
    assert far.finite().tolist() == [True, True, False, True, True]


WRITTEN = [".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".npz"]


@pytest.mark.parametrize("suffix", WRITTEN)
@given(data=st.data())
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_saved_file_holds_every_splat_or_saving_is_refused(suffix, data, tmp_path):
    splats = data.draw(extreme_splats(more=(np.nan, np.inf, 1e18, LARGEST, 100.0)))
    path = tmp_path / f"a{suffix}"
    try:
        nanogs.save(splats, path)
    except OutputError:
        assert not list(tmp_path.iterdir())
        return
    loaded = nanogs.load(path)
    path.unlink()
    assert len(loaded) == len(splats)
    assert loaded.finite().sum() == splats.finite().sum()


@pytest.mark.parametrize("size", [-2.0, 88.0])
def test_sog_holds_centres_at_the_end_of_single_precision(tmp_path, size):
    """Large splats spare bits; the bounds that this leaves were infinite, which nobody can read."""
    model = random_splats(5)
    model.log_scales[:] = size
    model.means[0], model.means[1] = LARGEST, -LARGEST
    nanogs.save(model, tmp_path / "a.sog")
    assert nanogs.load(tmp_path / "a.sog").means.max() == pytest.approx(LARGEST, rel=1e-3)
    with pytest.raises(OutputError, match=r"`spare_bits=6` leaves no room .* scale the model down"):
        nanogs.save(model, tmp_path / "b.sog", format_options={"spare_bits": 6})
    nanogs.save(model, tmp_path / "a.sog", format_options={"spare_bits": 0}, overwrite=True)
    assert [file.name for file in tmp_path.iterdir()] == ["a.sog"]


@pytest.mark.filterwarnings("error")
def test_colours_without_a_value_are_black_in_pictures():
    model = random_splats(60, degree=2)
    model.sh[:] = np.float32(3e38) * np.sign(model.sh)
    rendering = render(model, automatic_cameras(model, 1, width=64, height=64)[0])
    unknown = np.isnan(rendering.color)
    assert unknown.any()
    assert (color_image(rendering, transparent=False)[unknown] == 0).all()
    assert (color_image(rendering, transparent=True)[..., :3][unknown] == 0).all()
    assert (rendering.shown()[unknown] == 0).all()


@pytest.mark.filterwarnings("error")
def test_harmonics_near_zero_are_written_to_rad(tmp_path):
    model = random_splats(5, degree=1)
    model.sh[:, 1:] = 0
    model.sh[2, 1, 0] = 1e-42
    nanogs.save(model, tmp_path / "a.rad")
    assert np.abs(nanogs.load(tmp_path / "a.rad").sh[:, 1:]).max() == pytest.approx(1e-42, rel=1e-2)


@pytest.mark.filterwarnings("error")
def test_levels_of_splats_at_the_end_of_single_precision_have_a_width():
    model = random_splats(4)
    model.log_scales[:] = 88.5
    assert tiles._width(model) > 1e38


@pytest.mark.filterwarnings("error")
def test_scenes_as_large_as_single_precision_allows_are_compared():
    model = random_splats(60)
    model.means[:] *= np.float32(1e38)
    model.log_scales[:] += np.float32(np.log(1e38))
    [score] = nanogs.compare(model, model, views=2, pixels=64).models
    assert score.psnr == np.inf
    assert 0 <= nanogs.mode_evidence(model).faded <= 1


def test_a_view_with_an_infinite_depth_has_no_depth_error():
    rendering = SimpleNamespace(alpha=np.ones((2, 2)), depth=np.ones((2, 2)))
    beyond = SimpleNamespace(alpha=np.ones((2, 2)), depth=np.array([[1, 1], [1, np.inf]]))
    assert scores._depth(rendering, rendering) == 0
    assert scores._depth(rendering, beyond) is None
    beyond.alpha[1, 1] = 0  # not covered
    assert scores._depth(beyond, rendering) == 0


@pytest.mark.filterwarnings("error")
def test_steps_that_are_far_larger_than_splats_spare_no_bits():
    model = random_splats(5)
    model.log_scales[:] = -80
    assert Precision(7).spare_bits([model], lambda _: np.full((1, 1), 1e200)) == 0


def with_bits(model, column, bits):
    """Return the model with the given bits as the first number of its fourth splat."""
    changed = getattr(model, column).copy()
    changed[3:4].reshape(-1).view(bits.dtype)[0] = bits
    return replace(model, **{column: changed})


def with_signalling_nan(column):
    """Return a model with a NaN that raises a floating-point exception in any computation."""
    if column == "doubles":
        model = random_splats(50)
        bits = np.uint64(0x7FF0_0000_0000_0001)
        return with_bits(replace(model, means=model.means.astype(np.float64)), "means", bits)
    normals = {name: np.ones(50, np.float32) for name in ("nx", "ny", "nz")}
    if column == "normals":
        normals["ny"].view(np.uint32)[3] = 0x7F80_0001
        return random_splats(50, extras=normals)
    return with_bits(random_splats(50), column, np.uint32(0x7F80_0001))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("column", [*COLUMNS, "doubles", "normals"])
def test_signalling_nans_cause_no_warnings(column, tmp_path):
    """A flipped bit makes such a NaN from an infinity, in a file that can still be read."""
    path = tmp_path / "a.ply"
    nanogs.save(with_signalling_nan(column), path)
    assert nanogs.info(path).nonfinite == (column != "normals")
    filters = [nanogs.filters.sphere((0, 0, 0), 9), nanogs.filters.opaque_enough(0.1)]
    nanogs.convert(path, tmp_path / "b.ply", frame=("rdf", "rfu"), filters=filters)
    nanogs.simplify_blocks(path, tmp_path / "c.ply", ratio=0.5, preset="fast")
    nanogs.load(path).to_gsplat()
    for suffix in (".npz", ".spz", ".sog", ".rad", ".glb", ".usda", ".splat", ".compressed.ply"):
        if column == "normals" or suffix == ".npz":
            nanogs.convert(path, tmp_path / f"d{suffix}")
            continue
        with pytest.raises(OutputError, match="1 splat holds NaN or infinite values"):
            nanogs.convert(path, tmp_path / f"d{suffix}")


@pytest.mark.filterwarnings("error")
def test_doubles_beyond_the_float32_range_cause_no_warnings(tmp_path):
    model = random_splats(50)
    means = model.means.astype(np.float64)
    means[3:6] = [[1e300] * 3, [-1e40] * 3, [1e200, 0, 0]]
    path = tmp_path / "a.ply"
    nanogs.save(replace(model, means=means), path)
    assert nanogs.info(path).nonfinite == 3
    assert len(nanogs.filters.drop_floaters(nanogs.load(path))) == 47
    assert np.isinf(nanogs.load(path).to_gsplat()["means"]).sum() == 7
