"""OpenUSD: numbers are read back bit for bit, also by USD's own reader if it is installed."""

import dataclasses
import json
import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from builders import linear_scales, model_bytes, random_splats
from launch import run
from nanogs import io
from nanogs.errors import FormatError, OutputError
from nanogs.splats import RenderMode, Splats
from strategies import assert_same, splats

SHARED = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40
)


def written(path, model):
    io.save(model, path, overwrite=True)
    return path.read_text(encoding="utf-8")


def array(text, name, width):
    """Return an attribute's numbers, (R, width) float32."""
    match = re.search(rf"^    {re.escape(name)} = \[(.*?)\]$", text, re.MULTILINE | re.DOTALL)
    numbers = re.sub(r"[(),\s]+", " ", match[1]).split()
    assert match[1].count("(") == (len(numbers) // width if width > 1 else 0)
    return np.array(numbers, np.float32).reshape(-1, width)


@SHARED
@given(model=splats(max_n=9))
def test_every_number_is_written_exactly(tmp_path, monkeypatch, model):
    monkeypatch.setattr("nanogs.io.usda.write.BLOCK_ROWS", 4)
    text = written(tmp_path / "a.usda", model)
    coefficients = "float3[] radiance:sphericalHarmonicsCoefficients"
    assert np.array_equal(array(text, "point3f[] positions", 3), model.means.astype(np.float32))
    assert np.array_equal(array(text, "quatf[] orientations", 4), model.unit_quats())
    assert np.array_equal(array(text, "float3[] scales", 3), linear_scales(model))
    alphas = array(text, "float[] opacities", 1)[:, 0]
    assert np.array_equal(alphas, model.opacities().astype(np.float32))
    assert np.array_equal(array(text, coefficients, 3).reshape(model.sh.shape), model.sh)
    assert f"uniform int radiance:sphericalHarmonicsDegree = {model.sh_degree}\n" in text
    low, high = array(text, "float3[] extent", 3)
    assert (low <= model.means.min(axis=0)).all()
    assert (high >= model.means.max(axis=0)).all()


def test_the_stage_has_y_up_and_turns_the_model_there(tmp_path):
    text = written(tmp_path / "a.usda", random_splats(3))
    assert text.startswith("#usda 1.0\n")
    assert 'upAxis = "Y"' in text
    assert "xformOp:rotateZ = 180" in text
    assert 'defaultPrim = "Splats"' in text
    assert 'def ParticleField3DGaussianSplat "Splats"' in text
    assert text.endswith("]\n}\n")


def test_the_extent_covers_three_standard_deviations(tmp_path):
    model = random_splats(1)
    model.means[:] = 1, 2, 3
    model.log_scales[:] = np.log([0.5, 0.1, 0.2])
    low, high = array(written(tmp_path / "a.usda", model), "float3[] extent", 3)
    assert low == pytest.approx([-0.5, 0.5, 1.5], abs=1e-6)
    assert high == pytest.approx([2.5, 3.5, 4.5], abs=1e-6)


@pytest.mark.filterwarnings("error")
def test_the_extent_of_very_large_splats_stays_within_float32(tmp_path):
    model = random_splats(1)
    model.log_scales[:] = 88.5
    low, high = array(written(tmp_path / "a.usda", model), "float3[] extent", 3)
    limit = float(np.finfo(np.float32).max)
    assert low == pytest.approx([-limit] * 3)
    assert high == pytest.approx([limit] * 3)


def test_losses_name_what_is_left_out():
    model = dataclasses.replace(
        random_splats(3, extras={"label": np.arange(3)}),
        render_mode=RenderMode.MIP,
        comments=("a", "b"),
    )
    text = " ".join(io.losses(model, "a.usda"))
    for word in ("label", "2 comment lines", "render mode mip"):
        assert word in text
    assert io.losses(random_splats(3, degree=4), "a.usda") == ()


def test_non_finite_values_are_refused(tmp_path):
    model = random_splats(3)
    model.means[1] = np.nan
    with pytest.raises(OutputError, match="row 1"):
        io.save(model, tmp_path / "a.usda")
    assert list(tmp_path.iterdir()) == []


def test_the_command_converts_and_fits_a_size(tmp_path):
    io.save(random_splats(200), tmp_path / "a.ply")
    report = json.loads(run("convert", tmp_path / "a.ply", tmp_path / "a.usda", "--json").stdout)
    assert (report["format"], report["splats"], report["sh_degree"]) == ("usda", 200, 1)
    assert report["output_bytes"] == (tmp_path / "a.usda").stat().st_size
    size = report["output_bytes"] // 3
    options = ("--preset", "fast", "--size", size, "-q")
    assert run("simplify", tmp_path / "a.ply", tmp_path / "b.usda", *options).returncode == 0
    assert 0.9 * size < (tmp_path / "b.usda").stat().st_size <= size


def test_usd_itself_reads_the_file(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    geom = pytest.importorskip("pxr.UsdGeom")
    model = random_splats(20_000, degree=3)
    written(tmp_path / "a.usda", model)
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert geom.GetStageUpAxis(stage) == "Y"

    def value(name):
        return np.array(prim.GetAttribute(name).Get(), np.float32)

    coefficients = value("radiance:sphericalHarmonicsCoefficients")
    assert_same_splats(io.load(tmp_path / "a.usda"), model)
    loaded = Splats(
        means=value("positions"),
        log_scales=np.log(value("scales")),
        quats=np.array([[q.real, *q.imaginary] for q in prim.GetAttribute("orientations").Get()],
                       np.float32),
        opacity_logits=np.zeros(20_000, np.float32),
        sh=coefficients.reshape(20_000, 16, 3),
    )  # fmt: skip
    assert np.array_equal(loaded.means, model.means)
    assert np.array_equal(loaded.quats, model.unit_quats())
    assert np.array_equal(loaded.sh, model.sh)
    assert np.array_equal(value("opacities"), model.opacities().astype(np.float32))
    assert np.array_equal(value("scales"), linear_scales(model))
    up = geom.Xformable(prim).GetLocalTransformation().Transform((0, -1, 0))
    assert np.allclose(up, (0, 1, 0))


# Reading


def assert_same_splats(loaded, model):
    """Compare bit for bit what the file stores as it is, within float32 what is converted."""
    assert np.array_equal(loaded.means, model.means.astype(np.float32))
    assert np.array_equal(loaded.quats, model.unit_quats())
    assert np.array_equal(loaded.sh, model.sh)
    assert np.array_equal(np.isneginf(loaded.log_scales), np.isneginf(model.log_scales))
    finite = np.isfinite(model.log_scales)
    assert loaded.log_scales[finite] == pytest.approx(model.log_scales[finite], abs=2e-6)
    assert loaded.opacities() == pytest.approx(model.opacities(), abs=1e-7)


@SHARED
@given(model=splats(max_n=30))
def test_written_files_are_read_back(tmp_path, model):
    written(tmp_path / "a.usda", model)
    back = io.load(tmp_path / "a.usda")
    assert_same_splats(back, model)
    assert back.notes == ()
    info = io.inspect(tmp_path / "a.usda")
    assert (info.splats, info.sh_degree, info.encoding) == (len(model), model.sh_degree, "ascii")


def test_arrays_that_are_parsed_in_pieces_are_the_same(tmp_path, monkeypatch):
    written(tmp_path / "a.usda", random_splats(50, degree=2))
    whole = io.load(tmp_path / "a.usda")
    for piece in (1, 13, 300):
        monkeypatch.setattr("nanogs.io.usda.read._PIECE", piece)
        assert_same(io.load(tmp_path / "a.usda"), whole)


def test_memory_for_reading_is_bounded_by_the_text_and_twice_the_model(tmp_path):
    model = random_splats(20_000, degree=3)
    io.save(model, tmp_path / "a.usda")
    tracemalloc.start()
    io.load(tmp_path / "a.usda")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    text = (tmp_path / "a.usda").stat().st_size
    assert peak < text + 2 * len(model_bytes(model)) + 6_000_000


def layer(*prims, metadata='upAxis = "Y"'):
    return f"#usda 1.0\n# a comment\n(\n    {metadata}\n)\n" + "\n".join(prims)


def prim(body="", name="Splats", inside="", count=2):
    rows = {"positions": "(1, 2, 3)", "orientations": "(1, 0, 0, 0)", "scales": "(1, 2, 4)"}
    kinds = {"positions": "point3f", "orientations": "quatf", "scales": "float3"}
    fields = [f"{kinds[n]}[] {n} = [{', '.join([row] * count)}]" for n, row in rows.items()]
    fields += [
        f"float[] opacities = [{', '.join(['0.5'] * count)}]",
        "uniform int radiance:sphericalHarmonicsDegree = 0",
        "float3[] radiance:sphericalHarmonicsCoefficients = ["
        + ", ".join(["(0.1, 0.2, 0.3)"] * count) + "]",
    ]  # fmt: skip
    text = "\n    ".join([*fields, body])
    return f'def ParticleField3DGaussianSplat "{name}" {inside}\n{{\n    {text}\n}}'


@pytest.fixture
def load(tmp_path):
    def load(text):
        (tmp_path / "a.usda").write_text(text)
        return io.load(tmp_path / "a.usda")

    return load


def test_layers_of_other_programs_are_read(load):
    """Metadata, nested prims, relations, dictionaries, texts with brackets, several prims."""
    inside = """(
        kind = "component"
        customData = { string note = "a } and ] and #" }
    )"""
    body = '''rel material:binding = </Mat/A> (
        bindMaterialAs = "weakerThanDescendants"
    )
    custom string note = """three " quotes
    }""" ; asset file = @./a.png@
    token[] names = ["a]", "b"]
    float3[] extent
    def Scope "Below" { int a = 3 }'''
    text = layer(
        'over "World" (prepend apiSchemas = ["A"]) {',
        prim(body, inside=inside), prim(name="B", count=3), "}",
        metadata='defaultPrim = "World"\n subLayers = [@b.usda@]\n upAxis = "Y"',
    )  # fmt: skip
    loaded = load(text)
    assert len(loaded) == 5
    assert loaded.means[4].tolist() == [-1, -2, 3]  # y up, turned to y down
    assert loaded.log_scales[0] == pytest.approx(np.log([1, 2, 4]))
    assert loaded.sh[0, 0] == pytest.approx([0.1, 0.2, 0.3])


def test_splats_of_classes_are_not_read_because_they_are_not_drawn(load):
    inside = prim(name="Splats", count=3)
    body = ('class "Kinds" { def Xform "A" {', inside, "} }", prim(name="B"), inside)
    assert len(load(layer(*body))) == 5
    with pytest.raises(FormatError, match="has no splats"):
        load(layer(*body[:-2]))


def test_values_of_splats_beyond_the_schema_are_noted(load):
    body = """float[] primvars:label = [1, 2] (interpolation = "vertex")
    uniform token sortingModeHint = "zDepth"
    float3[] extent"""
    assert load(layer(prim(body))).notes == ("The attribute 'primvars:label' was left out.",)


def test_transforms_are_applied(load):
    outer = """def Xform "A" {
    double3 xformOp:translate = (10, 0, 0)
    float xformOp:rotateZ = 90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]"""
    inner = """float3 xformOp:scale:big = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:scale:big"]"""
    loaded = load(layer(outer, prim(inner), "}"))
    # (1, 2, 3) twice as large, a quarter turn about z, ten along x; then half a turn about z.
    assert loaded.means[0] == pytest.approx([-(10 - 4), -2, 6], abs=1e-5)
    assert loaded.log_scales[0] == pytest.approx(np.log([2, 4, 8]), abs=1e-6)
    assert np.abs(loaded.quats[0]) == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5], abs=1e-6)


def test_matrices_act_on_row_vectors(load):
    """The translation is the last row; the first row is where the x axis goes."""
    body = """matrix4d xformOp:transform = ((0, 1, 0, 0), (-1, 0, 0, 0), (0, 0, 1, 0), (5, 6, 7, 1))
    uniform token[] xformOpOrder = ["xformOp:transform"]"""
    loaded = load(layer(prim(body)))
    assert loaded.means[0] == pytest.approx([-(5 - 2), -(6 + 1), 7 + 3])  # then half a turn
    assert np.abs(loaded.quats[0]) == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5], abs=1e-6)


def test_arrays_in_half_precision_have_names_of_their_own(load):
    text = layer(prim())
    half = text.replace("[] positions", "[] positionsh").replace("[] opacities", "[] opacitiesh")
    half = half.replace("Coefficients =", "Coefficientsh =")
    assert_same(load(half), load(text))


def test_the_degree_is_three_if_none_is_stated(load):
    text = prim().replace("uniform int radiance:sphericalHarmonicsDegree = 0", "")
    model = load(layer(text.replace("(0.1, 0.2, 0.3)", ", ".join(["(0.1, 0.2, 0.3)"] * 16))))
    assert model.sh_degree == 3


def test_a_layer_of_several_prims_is_described_by_all_of_them(load, tmp_path):
    nine = ", ".join(["(1, 2, 3)"] * 4)
    second = prim(name="B", count=3).replace("Degree = 0", "Degree = 1")
    model = load(layer(prim(), second.replace("(0.1, 0.2, 0.3)", nine)))
    info = io.inspect(tmp_path / "a.usda")
    assert (info.splats, info.sh_degree) == (len(model), model.sh_degree) == (5, 1)


def test_z_up_is_converted_too(load):
    for metadata in ('upAxis = "Z"', 'defaultPrim = "Splats"\n    upAxis = "Z"'):
        assert load(layer(prim(), metadata=metadata)).means[0] == pytest.approx([-1, -3, -2])


def test_matrices_and_rotations_equal_those_of_usd(load, tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    geom = pytest.importorskip("pxr.UsdGeom")
    body = """double3 xformOp:translate = (1, -2, 3)
    float xformOp:rotateX = 20
    float xformOp:rotateY = -50
    matrix4d xformOp:transform:m = ((0, 2, 0, 0), (-2, 0, 0, 0), (0, 0, 2, 0), (5, 6, 7, 1))
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX", "xformOp:rotateY",
        "xformOp:transform:m"]"""
    loaded = load(layer(prim(body)))
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    found = geom.Xformable(stage.GetPrimAtPath("/Splats")).GetLocalTransformation()
    x, y, z = found.Transform((1, 2, 3))
    assert loaded.means[0] == pytest.approx([-x, -y, z], abs=1e-5)


REFUSED = {
    "other": ("#usda 1.0\n", "holds no ParticleField3DGaussianSplat"),
    "binary": ("PXR-USDC", "does not begin with '#usda"),
    "short": (layer(prim())[:-1], "ends inside the prim"),
    "array": (layer(prim()).partition("2, 3)")[0], "an array has no end"),
    "closing": (layer("}"), "has no matching {"),
    "brackets": (layer(prim("int a = (3]")), "brackets do not match"),
    "lacks": (layer(prim().replace("scales", "sizes")), "lacks scales"),
    "counts": (layer(prim().replace("opacities = [0.5, ", "opacities = [")), "has 1 number, where"),
    "more": (layer(prim().replace("opacities = [", "opacities = [1, ")), "has 3 numbers, where"),
    "half": (layer(prim().replace("Degree = 0", "Degree = 0.5")), "not from 0 to 4"),
    "infinite": (
        layer(prim("double3 xformOp:translate = (inf, 0, 0)\nuniform token[] xformOpOrder ="
                   ' ["xformOp:translate"]')), "needs 3 finite numbers"),
    "words": (layer(prim().replace("0.5, 0.5", "0.5, half")), "not a number"),
    "degree": (layer(prim().replace("Degree = 0", "Degree = 9")), "not from 0 to 4"),
    "none": (layer(prim(count=0)), "holds no splats"),
    "up": (layer(prim(), metadata='upAxis = "X"'), "upAxis"),
    "operation": (
        layer(prim('uniform token[] xformOpOrder = ["xformOp:orient"]')), "is not known"),
    "reset": (
        layer(prim('uniform token[] xformOpOrder = ["!resetXformStack!"]')), "is not known"),
    "mirror": (
        layer(prim("float3 xformOp:scale = (-1, 1, 1)\nuniform token[] xformOpOrder ="
                   ' ["xformOp:scale"]')), "mirrors or flattens"),
    "deep": (
        layer('def Xform "a" {' * 500), "usda: the prim 'a' has no body, or is nested too deeply"),
    "text": (layer('def "a'), "usda: byte [0-9]+ begins unknown syntax"),
}  # fmt: skip


def test_splats_with_negative_scales_are_counted(load):
    one = load(layer(prim().replace("scales = [(1, 2, 4)", "scales = [(-1, -2, 4)")))
    assert one.notes == ("1 splat has a negative scale, which became NaN.",)


def test_a_comment_may_end_the_file(load):
    assert_same(load(layer(prim()) + "\n# the end"), load(layer(prim())))


def test_opacities_out_of_range_are_counted(load):
    one = load(layer(prim().replace("opacities = [0.5, 0.5]", "opacities = [0.5, 1.5]")))
    assert one.notes == ("1 opacity is not from 0 to 1 and became NaN.",)
    both = load(layer(prim().replace("opacities = [0.5, 0.5]", "opacities = [-0.5, 1.5]")))
    assert both.notes == ("2 opacities are not from 0 to 1 and became NaN.",)
    prims = [prim().replace("[0.5, 0.5]", "[0.5, 2]"), prim("int[] primvars:a = [1, 2]", "B")]
    several = load(layer(prims[0], prims[1].replace("[0.5, 0.5]", "[-1, 2]")))
    assert several.notes == (
        "3 opacities are not from 0 to 1 and became NaN.",
        "The attribute 'primvars:a' was left out.",
    )


@pytest.mark.parametrize("name", REFUSED)
def test_unreadable_layers_are_refused(load, name):
    text, words = REFUSED[name]
    with pytest.raises(FormatError, match=words):
        load(text)


def test_long_comments_and_texts_are_skipped(load):
    hidden = 1_000 * f"{prim()} {{ ".replace("\n", " ")
    doc = hidden.replace('"', "'")
    loaded = load(layer(f"# {hidden}", f'def "a" (doc = "{doc}") {{ }}', prim()))
    assert len(loaded) == 2
