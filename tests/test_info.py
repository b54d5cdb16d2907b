"""`nanogs info`: results computed block by block equal those of the whole model."""

import copy
import dataclasses
import json
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from launch import run
from nanogs import io, percentiles
from nanogs.errors import OptionError
from nanogs.findings import Finding, join_findings
from nanogs.io import registry
from nanogs.io.formats import FAMILIES, of_family
from nanogs.model_info import info as describe
from nanogs.splats import RenderMode
from strategies import splats

SHARED = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40
)


def described(tmp_path, model, name="a.ply"):
    io.save(model, tmp_path / name, overwrite=True)
    return describe(tmp_path / name)


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of three rows, so that a few splats make several."""
    monkeypatch.setattr("nanogs.source.base.BLOCK_ROWS", 3)
    monkeypatch.setattr("nanogs.io.ply.rows.BLOCK_ROWS", 3)


@SHARED
@given(model=splats())
def test_the_blocks_of_a_source_make_up_the_model(tmp_path, small_blocks, model):
    io.save(model, tmp_path / "a.ply", overwrite=True)
    blocks = list(io.open(tmp_path / "a.ply").blocks())
    assert max(map(len, blocks)) <= 3
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh"):
        parts = np.concatenate([getattr(block, name) for block in blocks])
        assert parts.tobytes() == getattr(model, name).tobytes(), name
    for name, column in model.extras.items():
        parts = np.concatenate([block.extras[name] for block in blocks])
        assert parts.tobytes() == column.tobytes(), name
    assert {block.render_mode for block in blocks} == {model.render_mode}
    assert {len(block.elements) for block in blocks} == {len(model.elements)}


def test_save_returns_what_the_file_leaves_out(tmp_path):
    """Also for a source whose own file is replaced, and for an open file."""
    model = random_splats(9, degree=1, extras={"label": np.arange(9, dtype=np.int32)})
    lost = io.losses(model, "a.spz")
    assert any("label" in sentence for sentence in lost)
    assert io.save(model, tmp_path / "a.ply") == ()
    assert io.save(model, tmp_path / "a.spz") == lost
    assert io.save(model, BytesIO(), format=".spz") == lost
    with io.open(tmp_path / "a.ply") as source:
        assert io.save(source, tmp_path / "a.ply", format=".spz", overwrite=True) == lost
    assert io.load(tmp_path / "a.ply", format=".spz").extras == {}


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("a.spz", {"pallete": 3}, "no option 'pallete' \\(did you mean 'palette'"),
        ("a.spz", {"bits": 9}, "`bits` must be"),
        ("a.ply", {"bits": 6}, "`bits` is for"),
    ],
)
def test_losses_refuse_the_options_that_save_refuses(tmp_path, name, options, problem):
    model = random_splats(3, degree=0)
    for call in (io.losses, io.save):
        with pytest.raises(OptionError, match=problem):
            call(model, tmp_path / name, format_options=options)


@SHARED
@given(model=splats(max_n=12))
def test_losses_found_in_blocks_are_those_of_the_whole_model(tmp_path, small_blocks, model):
    wide = np.where(np.arange(len(model))[:, None, None] % 2, 5, 1).astype(np.float32)
    model = dataclasses.replace(
        model, sh=model.sh * wide, log_scales=model.log_scales * 3, means=model.means * 3000
    )
    found = described(tmp_path, model).losses
    loaded = io.load(tmp_path / "a.ply")
    assert set(found) == {known.suffix for known in registry.formats() if known.writable}
    for suffix, sentences in found.items():
        # The names of columns may be in another order if the normals of the first rows are zero.
        assert sorted(map(sorted, sentences)) == sorted(
            map(sorted, io.losses(loaded, f"a{suffix}"))
        ), suffix


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("ask", [io.losses, io.derived_options])
def test_invalid_format_options_are_refused_as_by_save(ask, degree):
    model = random_splats(3, degree=degree)
    for suffix in (".spz", ".sog", ".ply"):
        with pytest.raises(OptionError, match="There is no option 'version'"):
            ask(model, f"a{suffix}", {"version": 2})
        with pytest.raises(OptionError, match="Format options are a dictionary"):
            ask(model, f"a{suffix}", [6])
    for bits in (99, 6.0):
        with pytest.raises(OptionError, match="`bits` must be a whole number from 4 to 8"):
            ask(model, "a.spz", {"bits": bits})


def test_statistics_equal_those_of_numpy(tmp_path):
    model = random_splats(20_000, degree=1)
    model.opacity_logits[:5] = np.inf
    model.means[7] = np.nan
    info = described(tmp_path, model)
    finite = np.delete(np.arange(len(model)), 7)
    alphas, scales = model.opacities()[finite], model.scales()[finite]
    assert info.alpha.median == pytest.approx(np.median(alphas))
    assert (info.alpha.p5, info.alpha.p99) == pytest.approx(np.percentile(alphas, [5, 99]))
    assert (info.scale.min, info.scale.max) == (scales.min(), scales.max())
    assert info.scale.p25 == pytest.approx(np.percentile(scales, 25))
    assert (info.nonfinite, info.opaque, info.transparent) == (1, 5, 0)
    low, high = model.means[finite].min(axis=0), model.means[finite].max(axis=0)
    assert np.array_equal(info.bounds, [low, high])


def test_a_model_without_finite_splats_has_no_statistics(tmp_path):
    model = random_splats(3)
    model.means[:] = np.nan
    info = described(tmp_path, model)
    assert (info.bounds, info.alpha, info.scale, info.nonfinite) == ((), None, None, 3)
    assert run("info", tmp_path / "a.ply").returncode == 0


def test_formats_that_refuse_a_model_do_not_hold_it_whole(tmp_path, small_blocks):
    model = random_splats(8)
    model.means[[1, 6]] = np.nan
    losses = described(tmp_path, model).losses
    for suffix, sentences in losses.items():
        assert io.losses(model, f"a{suffix}") == sentences
        said = f"2 splats hold NaN or infinite values, {suffix} refuses the model."
        assert (said in sentences) == (suffix not in (".ply", ".npz", ".csv"))
        if suffix not in (".ply", ".npz", ".csv", "meta.json"):
            with pytest.raises(nanogs.NanogsError, match="2 splats hold NaN"):
                io.save(model, tmp_path / f"b{suffix}")
    shown = run("info", tmp_path / "a.ply").stdout
    assert re.search(r"fits whole into +\.ply, \.npz, \.csv\n", shown), shown


def test_extra_columns_that_a_format_refuses_are_told_beforehand(tmp_path):
    model = random_splats(9, extras={"seen": np.arange(9) % 2 == 0})
    refusal = "Column 'seen' is bool, which PLY cannot hold; convert it to one of "
    found = described(tmp_path, model, "a.npz").losses
    assert [each.partition("char")[0] for each in found[".ply"]] == [refusal]
    assert io.losses(model, "a.ply") == found[".ply"]
    assert found[".npz"] == io.losses(model, "a.npz") == ()
    shown = run("info", str(tmp_path / "a.npz")).stdout
    assert re.search(r"fits whole into +\.npz, \.csv\n", shown), shown


def test_values_beyond_the_float32_range_are_counted_over_all_blocks(tmp_path, small_blocks):
    names = [p for p, _ in io.inspect(_saved(tmp_path, 8)).properties]
    rows = np.zeros(8, [(name, "f8") for name in names])
    rows["opacity"] = 1e300
    rows["rot_0"] = 1
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 8"]
    lines += [*(f"property double {name}" for name in names), "end_header", ""]
    (tmp_path / "b.ply").write_bytes("\n".join(lines).encode() + rows.tobytes())
    notes = describe(tmp_path / "b.ply").notes
    assert "8 values of 'opacity' became infinite when converted to float32." in notes
    assert notes == tuple(io.load(tmp_path / "b.ply").notes)


def _saved(tmp_path, count):
    io.save(random_splats(count, degree=0), tmp_path / "a.ply", overwrite=True)
    return tmp_path / "a.ply"


READ_AND_WRITTEN = [known.suffix for known in registry.formats() if known.write and known.readable]


@pytest.mark.parametrize("suffix", READ_AND_WRITTEN)
def test_every_format_is_described(tmp_path, suffix):
    model = dataclasses.replace(random_splats(70, degree=1), render_mode=RenderMode.MIP)
    info = described(tmp_path, model, f"a{suffix}")
    assert info.file.splats == 70
    assert info.frame
    kept = suffix not in (".splat", ".usda", ".csv")
    assert info.file.render_mode is (RenderMode.MIP if kept else RenderMode.DEFAULT)
    assert any("render mode" in text for text in info.losses[".splat"]) is kept


def test_json_has_all_entries(tmp_path):
    report = json.loads(run("info", _saved(tmp_path, 9), "--json").stdout)
    assert set(report["alpha"]) == {
        "min", "p1", "p5", "p25", "median", "p75", "p95", "p99", "max"
    }  # fmt: skip
    assert report["frame"].startswith("not stated")
    assert report["losses"][".ply"] == []
    assert report["properties"][0] == ["x", "float"]


def test_findings_of_parts_are_joined():
    parts = [
        ("plain", Finding("{:,} splats", 700)),
        (Finding("{:,} splats", 500), Finding("1/{}", 4, min)),
        ("plain", Finding("1/{}", 2, min)),
    ]
    assert join_findings(parts) == ("plain", "1,200 splats", "1/2")
    assert join_findings([]) == ()
    copied = copy.deepcopy(parts[0][1])
    assert (type(copied), copied) == (str, "700 splats")


@pytest.mark.parametrize("name", ["biker.spz", "skull.sog", "chair.splat", "guitar.compressed.ply"])
def test_real_scenes_have_plausible_statistics(name):
    info = describe(scene_path(name))
    assert info.file.splats == len(nanogs.load(scene_path(name)))
    assert info.scale.min < info.scale.median < info.scale.max


def test_every_family_of_formats_is_registered():
    folder = Path(io.__file__).parent
    files = [*folder.glob("*.py"), *folder.glob("*/__init__.py")]
    found = {
        file.parent.name if file.name == "__init__.py" else file.stem
        for file in files
        if re.search(r"^FORMATS = ", file.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert sorted(found) == sorted(FAMILIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_table_of_formats_has_the_suffixes_of_each_family(family):
    assert FAMILIES[family] == tuple(known.suffix for known in of_family(family))


@given(
    st.lists(st.floats(0, 2.0**90, width=32), max_size=300), st.integers(1, 300), st.booleans()
)  # fmt: skip
def test_percentiles_are_exact_for_held_and_for_counted_values(values, size, few):
    values = np.array(values, np.float32)
    if few:
        values = np.round(values % 4)  # many equal values
    shares = (0, 1, 25, 50, 99, 100)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(percentiles, "HELD", 0)
        counted = percentiles.Percentiles(300, shares)
        assert counted.again
        blocks = [values[start : start + size] for start in range(0, len(values), size)]
        for add in (counted.add, counted.add_second_pass):
            for block in blocks:
                add(block)
    if not len(values):
        assert counted.values() is None
        return
    expected = np.percentile(values.astype(np.float64), shares)
    assert counted.values() == pytest.approx(expected, rel=1e-12)
    held = percentiles.Percentiles(300, shares)
    for block in blocks:
        held.add(block)
    assert not held.again
    assert held.values() == pytest.approx(expected, rel=1e-6)


def test_a_description_is_plain_json_data(tmp_path):
    nanogs.save(random_splats(10), tmp_path / "a.ply")
    plain = nanogs.info(tmp_path / "a.ply").to_dict()
    assert json.loads(json.dumps(plain))["path"] == str(tmp_path / "a.ply")


def test_a_large_model_gets_the_same_description_as_a_small_one(tmp_path, monkeypatch):
    splats = random_splats(3000, degree=1)
    splats.means[5] = np.nan
    nanogs.save(splats, tmp_path / "a.ply")
    expected = nanogs.info(tmp_path / "a.ply").to_dict()
    monkeypatch.setattr(percentiles, "HELD", 4000)  # enough for all alphas, but not for all scales
    description = nanogs.info(tmp_path / "a.ply").to_dict()
    for name in ("alpha", "scale"):
        assert description.pop(name) == pytest.approx(expected.pop(name), rel=1e-6)
    assert description == expected


def columns_of(model):
    """The columns of a `.ply` that have statistics, with the values that these are of."""
    yield from zip("xyz", model.means.T, strict=True)
    yield from zip(("f_dc_0", "f_dc_1", "f_dc_2"), model.sh[:, 0].T, strict=True)
    if model.sh_degree:
        yield "f_rest, band 1", model.sh[:, 1:4]
    yield "opacity", model.opacity_logits
    yield from ((f"scale_{axis}", model.log_scales[:, axis]) for axis in range(3))
    yield from ((f"rot_{place}", model.quats[:, place]) for place in range(4))
    yield from model.extras.items()


def test_statistics_of_columns_are_those_of_all_rows(tmp_path, small_blocks):
    model = random_splats(50, degree=1, extras={"label": np.arange(50, dtype=np.uint8)})
    model.means[:2, 1], model.log_scales[3, 2], model.sh[4, 2, 1] = np.nan, -np.inf, np.nan
    model.opacity_logits[:7] = np.inf
    io.save(model, tmp_path / "a.ply")
    found = {each.column: each for each in describe(tmp_path / "a.ply", columns=True).columns}
    expected = dict(columns_of(model))
    assert list(found) == list(expected)
    for name, values in expected.items():
        finite = values[np.isfinite(values)].astype(np.float64)
        one = found[name]
        assert (one.nan, one.infinite) == (np.isnan(values).sum(), np.isinf(values).sum()), name
        assert (one.min, one.max) == (finite.min(), finite.max()), name
        assert one.mean == pytest.approx(finite.mean(), rel=1e-12, abs=1e-12), name
        assert one.std == pytest.approx(finite.std(), rel=1e-12), name
    assert describe(tmp_path / "a.ply").columns == ()


def test_a_column_without_finite_values_has_no_statistics(tmp_path):
    model = random_splats(3, extras={"[red]": np.ones(3, np.float32)})
    model.opacity_logits[:] = np.inf
    io.save(model, tmp_path / "a.ply")
    shown = run("info", tmp_path / "a.ply", "--columns")
    assert shown.returncode == 0, shown.stderr
    assert re.search(r"^ *\[red\] +1 +1 +0 +1 +0 +0$", shown.stdout, re.MULTILINE)
    assert re.search(r"^ *opacity +- +- +- +- +0 +3$", shown.stdout, re.MULTILINE)
    data = json.loads(run("info", tmp_path / "a.ply", "--columns", "--json").stdout)
    [opacity] = [each for each in data["columns"] if each["column"] == "opacity"]
    assert (opacity["mean"], opacity["infinite"]) == (None, 3)
    assert json.loads(run("info", tmp_path / "a.ply", "--json").stdout)["columns"] == []
