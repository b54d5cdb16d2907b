"""Filters: which splats they keep, what they report, and how they combine."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from launch import run
from nanogs import filters
from nanogs.cli.file_options import Edits
from nanogs.cli.filtering import parse_filters
from nanogs.errors import ModelError, OptionError
from nanogs.splats import ExtraElement
from strategies import assert_same


def splats_at(points, scale=0.01, **kwargs):
    """Return splats of one size at the given points."""
    points = np.asarray(points, np.float32)
    base = random_splats(len(points), **kwargs)
    logs = np.full((len(points), 3), np.log(scale), np.float32)
    return dataclasses.replace(base, means=points, log_scales=logs)


# Crops


def three(lowest, highest):
    return st.tuples(*[st.floats(lowest, highest)] * 3).map(np.array)


@given(seed=st.integers(0, 1000), size=three(0.2, 2), shift=three(-0.5, 0.5))
def test_a_box_keeps_the_splats_inside(seed, size, shift):
    model = random_splats(200, seed=seed)
    low, high = shift - size / 2, shift + size / 2
    inside = [all(low[a] <= float(p[a]) <= high[a] for a in range(3)) for p in model.means]
    if not any(inside):
        with pytest.raises(ModelError, match="leaves none of 200 splats"):
            filters.crop_box(model, low, high)
        return
    assert_same(filters.crop_box(model, low, high), model.take(np.array(inside)))


@given(seed=st.integers(0, 1000), radius=st.floats(0.3, 2))
def test_a_sphere_keeps_the_splats_inside(seed, radius):
    model, centre = random_splats(200, seed=seed), (0.1, -0.2, 0.3)
    inside = np.array([np.sum((p.astype(float) - centre) ** 2) <= radius**2 for p in model.means])
    if not inside.any():
        with pytest.raises(ModelError, match="leaves none of 200 splats"):
            filters.crop_sphere(model, centre, radius)
        return
    assert_same(filters.crop_sphere(model, centre, radius), model.take(inside))


def test_crops_include_their_boundary_and_exclude_nonfinite_centres():
    model = splats_at([[0, 0, 0], [1, 1, 1], [1, 1, 1.001], [np.nan, 0, 0], [0, np.inf, 0]])
    assert len(filters.crop_box(model, (0, 0, 0), (1, 1, 1))) == 2
    assert len(filters.crop_sphere(splats_at([[0, 0, 2], [0, 0, 2.001]]), (0, 0, 0), 2)) == 1
    assert len(filters.crop_sphere(model, (0, 0, 0), 1e200)) == 3


# Opacity


def test_min_opacity_drops_only_splats_below_it():
    model = random_splats(300)
    model.opacity_logits[:5] = 0, np.inf, -np.inf, np.nan, -1e-3
    left = filters.min_opacity(model, 0.5)
    assert len(left) == 1 + 1 + 1 + int((model.opacities()[5:] >= 0.5).sum())
    assert np.isnan(left.opacity_logits).sum() == 1
    assert_same(filters.min_opacity(model, 0), model)
    opaque = filters.min_opacity(model, 1)
    assert ((opaque.opacities() >= 1) | np.isnan(opaque.opacity_logits)).all()
    assert (opaque.opacity_logits[:1] == np.inf).all()


# Floaters


def cloud(count=3000, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3))


def rows_without_floaters(points, **kwargs):
    model = splats_at(points, **kwargs)
    labelled = dataclasses.replace(model, extras={"row": np.arange(len(model))})
    return set(filters.drop_floaters(labelled).extras["row"].tolist())


@pytest.mark.parametrize("group", [1, 2, 8])
def test_small_groups_far_away_are_floaters(group):
    far = np.array([60.0, 0, 0]) + np.random.default_rng(1).normal(size=(group, 3)) * 1e-3
    rows = rows_without_floaters([*cloud(), *far])
    assert not rows & set(range(3000, 3000 + group))
    assert len(rows) >= 0.995 * 3000


def test_larger_groups_far_away_are_not_floaters():
    far = np.array([60.0, 0, 0]) + np.random.default_rng(1).normal(size=(9, 3)) * 1e-3
    assert set(range(3000, 3009)) <= rows_without_floaters([*cloud(), *far])


def test_a_splat_as_large_as_the_gap_around_it_is_not_a_floater():
    model = splats_at([*cloud(), [60, 0, 0]])
    model.log_scales[-1, 1] = np.log(30)
    assert np.float32(60) in filters.drop_floaters(model).means[:, 0]
    model.log_scales[-1, 1] = np.log(1)
    assert np.float32(60) not in filters.drop_floaters(model).means[:, 0]


@pytest.mark.parametrize("scale", [1e-6, 1, 1e6])
def test_the_scale_of_the_scene_does_not_matter(scale):
    points = np.array([*cloud(), [60, 0, 0], [0, 0, -45]])
    assert rows_without_floaters(points * scale, scale=0.01 * scale) == rows_without_floaters(
        points
    )


@pytest.mark.parametrize("deviations", [3000, 1e308])
def test_no_splat_is_a_floater_for_any_large_number_of_deviations(deviations):
    model = splats_at([*cloud(50), [60, 0, 0]])
    assert_same(filters.drop_floaters(model, deviations=deviations), model)


def test_regular_grids_and_coincident_splats_have_no_floaters():
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    assert len(rows_without_floaters(grid)) == 512
    assert len(rows_without_floaters(np.zeros((50, 3)))) == 50
    assert len(rows_without_floaters([[0, 0, 0]])) == 1
    assert len(rows_without_floaters([[0, 0, 0], [5, 0, 0], [0, 7, 0]])) == 3
    # Most are coincident, so that the usual distance is taken from the others.
    assert len(rows_without_floaters([*np.zeros((500, 3)), *cloud(300)])) >= 795


@pytest.mark.parametrize(("gap", "left"), [(4.4, 101), (4.6, 100)])
def test_evenly_spaced_splats_are_no_reason_to_remove_one_a_few_steps_away(gap, left):
    """The deviation counts as 0.3 at least: up to exp(5 * 0.3) = 4.48 times the distance."""
    along = np.append(np.arange(100), 99 + gap)
    model = splats_at(np.stack([along, 0 * along, 0 * along], axis=1))
    assert len(filters.drop_floaters(model, neighbours=1)) == left


def test_drop_floaters_keeps_nonfinite_splats():
    model = splats_at([*cloud(), [np.nan, 0, 0], [60, 0, 0]])
    left = filters.drop_floaters(model)
    assert np.isnan(left.means).any(axis=1).sum() == 1
    assert np.float32(60) not in left.means[:, 0]


def test_floaters_equal_those_found_by_brute_force():
    points = np.array([*cloud(400), *(cloud(30, 5) * 6)])
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    to_eighth_neighbour = np.sort(distances, axis=1)[:, 8]
    log_distances = np.log(to_eighth_neighbour)
    median = np.median(log_distances)
    spread = max(1.4826 * np.median(np.abs(log_distances - median)), 0.3)
    expected = (log_distances > median + 5 * spread) & (to_eighth_neighbour > 3 * 0.01)
    assert 0 < expected.sum() < 30
    assert rows_without_floaters(points) == set(np.flatnonzero(~expected).tolist())


def test_drop_floaters_removes_some_splats_of_a_scene_with_floaters():
    model = nanogs.load(scene_path("chair.splat"))
    left = filters.drop_floaters(model)
    assert 0.01 < 1 - len(left) / len(model) < 0.05
    clean = nanogs.load(scene_path("biker.spz"))
    assert len(filters.drop_floaters(clean)) == len(clean)


# Several filters


def test_each_filter_is_applied_to_the_result_of_the_previous_one():
    model = random_splats(500)
    chosen = [filters.opaque_enough(0.5), filters.sphere((0, 0, 0), 1)]
    left, reports = filters.apply(model, chosen)
    assert_same(left, filters.crop_sphere(filters.min_opacity(model, 0.5), (0, 0, 0), 1))
    assert [report.name for report in reports] == ["min-opacity", "crop"]
    assert reports[0].left == len(model) - reports[0].removed
    assert reports[1].left == len(left) == reports[0].left - reports[1].removed
    assert filters.apply(model, [])[0] is model


def test_elements_with_one_row_per_splat_cannot_be_filtered():
    rows = np.zeros(20, [("a", "f4")])
    model = dataclasses.replace(random_splats(20), elements=[ExtraElement("twin", rows)])
    with pytest.raises(ModelError, match="'twin'"):
        filters.min_opacity(model, 0.5)
    assert len(filters.min_opacity(model, 0)) == 20


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: filters.crop_box(s, (0, 0), (1, 1, 1)), "three finite numbers"),
        (lambda s: filters.crop_box(s, (0, 0, np.nan), (1, 1, 1)), "three finite numbers"),
        (lambda s: filters.crop_box(s, (0, 2, 0), (1, 1, 1)), "must not be above the highest"),
        (lambda s: filters.crop_sphere(s, (0, 0, 0), 0), "radius .* not 0"),
        (lambda s: filters.crop_sphere(s, (0, 0, 0), float("nan")), "radius .* not nan"),
        (lambda s: filters.crop_sphere(s, (0, 0, 0), float("inf")), "radius .* not inf"),
        (lambda s: filters.min_opacity(s, 1.1), r"opacity .* not 1\.1"),
        (lambda s: filters.min_opacity(s, 1 + 1e-9), r"opacity .* not 1\.000000001"),
        (lambda s: filters.min_opacity(s, float("nan")), "opacity .* not nan"),
        (lambda s: filters.drop_floaters(s, neighbours=0), "neighbours .* not 0"),
        (lambda s: filters.drop_floaters(s, deviations=0), "deviations .* not 0"),
        (lambda _s: parse_filters(Edits(crop=["box:1,2,3"])), "not 'box:1,2,3'"),
        (lambda _s: parse_filters(Edits(crop=["ball:1,2,3,4"])), "not 'ball:1,2,3,4'"),
        (lambda _s: parse_filters(Edits(crop=["sphere:a,b,c,d"])), "not 'sphere:a,b,c,d'"),
    ],
)
def test_invalid_filter_arguments_are_refused(call, message):
    with pytest.raises(OptionError, match=message):
        call(random_splats(5))


def test_reports_name_the_numbers_of_filters_exactly():
    """Six digits would make a box in map coordinates empty, or another one."""
    for made, text in [
        (filters.box((455123.75, 0, -0.5), (455124.25, 1, 1e20)),
         "crop box:455123.75,0,-0.5,455124.25,1,1e+20"),
        (filters.sphere((0.1, 5000001, 0), np.float64(1 / 3)),
         "crop sphere:0.1,5000001,0,0.3333333333333333"),
        (filters.opaque_enough(1 / 255), "min-opacity 0.00392156862745098"),
    ]:  # fmt: skip
        assert f"{made.name} {made.argument}" == text


# Commands


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    model = random_splats(400)
    model.means[0] = 500
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    nanogs.save(model, path)
    return path


OPTIONS = ("--drop-floaters", "--min-opacity", 0.3, "--crop", "box:-1,-1,-1,1,1,500")


def with_nan():
    """A model whose rows 1 to 4 are not finite; rows 5 to 7 hold infinities that are allowed."""
    model = random_splats(40, degree=1)
    model.means[1, 2], model.log_scales[2, 0] = np.nan, np.inf
    model.quats[3, 1], model.sh[4, 2, 1] = np.inf, np.nan
    model.log_scales[5, 0], model.opacity_logits[6:8] = -np.inf, (np.inf, -np.inf)
    return model


def test_drop_nan_removes_splats_that_are_not_finite():
    model = with_nan()
    left = filters.drop_nan(model)
    assert_same(left, model.take(np.r_[0, 5:40]))
    assert_same(filters.drop_nan(left), left)


@pytest.mark.parametrize("suffix", [".sog", ".spz", ".glb", ".compressed.ply"])
def test_what_drop_nan_leaves_can_be_written(tmp_path, suffix):
    nanogs.save(with_nan(), tmp_path / "a.ply")
    chosen = [filters.all_finite(), filters.opaque_enough(0)]
    report = nanogs.convert(tmp_path / "a.ply", tmp_path / f"b{suffix}", filters=chosen)
    assert [(each.name, each.removed) for each in report.filters] == [
        ("drop-nan", 4), ("min-opacity", 0),
    ]  # fmt: skip
    assert len(nanogs.load(tmp_path / f"b{suffix}")) == 36


def test_drop_nan_comes_first_in_commands(tmp_path):
    nanogs.save(with_nan(), tmp_path / "a.ply")
    options = ("-r", 0.5, "--preset", "fast", "--nan", "error", "--min-opacity", 0, "--json")
    result = run("simplify", tmp_path / "a.ply", tmp_path / "b.ply", *options)
    assert (result.returncode, result.stdout) == (2, "")
    result = run("simplify", tmp_path / "a.ply", tmp_path / "b.ply", *options, "--drop-nan")
    report = json.loads(result.stdout)
    assert [each["name"] for each in report["filters"]] == ["drop-nan", "min-opacity"]
    assert report["input_count"] == 36


def test_simplify_takes_the_ratio_of_the_filtered_model(scene, tmp_path):
    small = tmp_path / "a.ply"
    options = ("-r", 0.5, "--preset", "fast", *OPTIONS)
    report = json.loads(run("simplify", scene, small, *options, "--json").stdout)
    names = [entry["name"] for entry in report["filters"]]
    assert names == ["crop", "min-opacity", "drop-floaters"]
    assert report["read_count"] == 400
    assert report["filters"][0]["removed"] == 1
    left = report["filters"][-1]["left"]
    assert report["input_count"] == left < 400
    assert report["achieved_count"] == len(nanogs.load(small)) == -(-left // 2)
    assert "filter" in report["seconds"]
    messages = run("simplify", scene, small, *options, "-w", "-v").stderr
    assert "crop box:-1,-1,-1,1,1,500 removed 1 splat; 399 are left." in messages
    assert f"input count {left}" in " ".join(messages.split())
    plan = run("simplify", scene, tmp_path / "b.ply", *options, "--dry-run", "--json").stdout
    assert json.loads(plan)["asked_count"] == report["achieved_count"]


def test_convert_filters_without_merging(scene, tmp_path):
    result = run("convert", scene, tmp_path / "a.ply", *OPTIONS, "--json")
    report = json.loads(result.stdout)
    assert report["splats"] == report["filters"][-1]["left"]
    expected = filters.crop_box(nanogs.load(scene), (-1, -1, -1), (1, 1, 500))
    expected = filters.drop_floaters(filters.min_opacity(expected, 0.3))
    assert_same(nanogs.load(tmp_path / "a.ply"), expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--crop", "box:1,2"), "sphere:x,y,z,r"),
        (("--crop", "sphere:9000,0,0,1"), "leaves none of 400 splats"),
        (("--min-opacity", 2), "from 0 to 1"),
    ],
)
def test_commands_with_invalid_filters_write_nothing(scene, tmp_path, options, message):
    for command in (("simplify", "-r", 0.5), ("convert",)):
        result = run(command[0], scene, tmp_path / "a.ply", *command[1:], *options)
        assert (result.returncode, result.stdout) == (2, "")
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "chosen",
    [
        filters.box((-1, -2, -3), (1, 0.5, 3)), filters.sphere((0.5, 0, 0), 1.2),
        filters.within((0.5, 0, 0), 0.8), filters.beyond((0.5, 0, 0), 0.8),
        filters.opaque_enough(0.4), filters.in_company(1, 0.5), filters.all_finite(),
    ],
    ids=lambda chosen: chosen.plain[0],
)  # fmt: skip
def test_a_filter_made_from_its_plain_form_is_equal(chosen):
    splats = random_splats(200)
    splats.sh[7, 0] = np.nan
    restored = filters.filter_of(*chosen.plain)
    assert (restored.name, restored.argument, restored.plain) == (
        chosen.name, chosen.argument, chosen.plain,
    )  # fmt: skip
    kept = chosen.keep(splats)
    assert 0 < kept.sum() < 200
    assert np.array_equal(restored.keep(splats), kept)


def test_an_unknown_filter_is_refused():
    with pytest.raises(OptionError, match="There is no filter 'cube'"):
        filters.filter_of("cube", ())


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("box", (1.0, 2.0)), ("box", (0.0,) * 7), ("sphere", ()), ("within", (0.0,) * 3),
        ("beyond", ("a",) * 4), ("opacity", ()), ("opacity", 0.5), ("opacity", (0.5, 0.5)),
        ("company", (8.0,)), ("company", (math.nan, 5.0)), ("company", (math.inf, 5.0)),
        ("company", (2.5, 5.0)), ("sphere", (0.0, 0.0, math.nan, 1.0)),
    ],
)  # fmt: skip
def test_a_damaged_record_of_a_filter_is_refused(kind, values):
    with pytest.raises(OptionError):
        filters.filter_of(kind, values)


@pytest.mark.parametrize("kind", [None, 3, ["box"]])
def test_a_kind_of_filter_that_is_no_text_is_refused(kind):
    with pytest.raises(OptionError, match="There is no filter"):
        filters.filter_of(kind, (1.0,) * 4)
