"""Writing OpenUSD: the numbers come back bit by bit, by USD's own reader too where it is there."""

import dataclasses
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from builders import random_splats
from nanogs import io
from nanogs.errors import FormatError, OutputError
from nanogs.splats import RenderMode, Splats
from strategies import splats

SHARED = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40
)


def written(path, model):
    io.save(model, path, overwrite=True)
    return path.read_text(encoding="utf-8")


def array(text, name, width):
    """An attribute's numbers, (R, width) float32."""
    match = re.search(rf"^    {re.escape(name)} = \[(.*?)\]$", text, re.MULTILINE | re.DOTALL)
    numbers = re.sub(r"[(),\s]+", " ", match[1]).split()
    assert match[1].count("(") == (len(numbers) // width if width > 1 else 0)
    return np.array(numbers, np.float32).reshape(-1, width)


@SHARED
@given(model=splats(max_n=9))
def test_every_number_comes_back(tmp_path, monkeypatch, model):
    monkeypatch.setattr("nanogs.io.usda_write.BLOCK_ROWS", 4)
    text = written(tmp_path / "a.usda", model)
    coefficients = "float3[] radiance:sphericalHarmonicsCoefficients"
    assert np.array_equal(array(text, "point3f[] positions", 3), model.means.astype(np.float32))
    assert np.array_equal(array(text, "quatf[] orientations", 4), model.unit_quats())
    assert np.array_equal(array(text, "float3[] scales", 3), model.scales())
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


def test_the_extent_holds_three_deviations(tmp_path):
    model = random_splats(1)
    model.means[:] = 1, 2, 3
    model.log_scales[:] = np.log([0.5, 0.1, 0.2])
    low, high = array(written(tmp_path / "a.usda", model), "float3[] extent", 3)
    assert low == pytest.approx([-0.5, 0.5, 1.5], abs=1e-6)
    assert high == pytest.approx([2.5, 3.5, 4.5], abs=1e-6)


def test_what_is_left_out_is_said(tmp_path):
    model = dataclasses.replace(
        random_splats(3, extras={"label": np.arange(3)}), render_mode=RenderMode.MIP, comments="ab"
    )
    text = " ".join(io.losses(model, "a.usda"))
    for word in ("label", "2 comment lines", "render mode mip"):
        assert word in text
    assert io.losses(random_splats(3, degree=4), "a.usda") == ()


def test_what_it_cannot_hold_is_refused(tmp_path):
    model = random_splats(3)
    model.means[1] = np.nan
    with pytest.raises(OutputError, match="row 1"):
        io.save(model, tmp_path / "a.usda")
    assert list(tmp_path.iterdir()) == []
    written(tmp_path / "a.usda", random_splats(3))
    for use in (io.load, io.inspect):
        with pytest.raises(FormatError, match="does not read"):
            use(tmp_path / "a.usda")


def test_the_command_converts_and_fits_a_size(tmp_path):
    io.save(random_splats(200), tmp_path / "a.ply")
    nanogs = [sys.executable, "-m", "nanogs"]
    convert = [*nanogs, "convert", tmp_path / "a.ply", tmp_path / "a.usda", "--json"]
    report = json.loads(subprocess.run(convert, capture_output=True).stdout)
    assert (report["format"], report["splats"], report["sh_degree"]) == ("usda", 200, 1)
    assert report["output_bytes"] == (tmp_path / "a.usda").stat().st_size
    size = report["output_bytes"] // 3
    simplify = [*nanogs, "simplify", tmp_path / "a.ply", tmp_path / "b.usda", "--preset", "fast"]
    subprocess.run([*simplify, "--size", str(size), "-q"], check=True)
    assert 0.9 * size < (tmp_path / "b.usda").stat().st_size <= size


def test_usd_itself_reads_it(tmp_path):
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
    back = Splats(
        means=value("positions"),
        log_scales=np.log(value("scales")),
        quats=np.array([[q.real, *q.imaginary] for q in prim.GetAttribute("orientations").Get()],
                       np.float32),
        opacity_logits=np.zeros(20_000, np.float32),
        sh=coefficients.reshape(20_000, 16, 3),
    )  # fmt: skip
    assert np.array_equal(back.means, model.means)
    assert np.array_equal(back.quats, model.unit_quats())
    assert np.array_equal(back.sh, model.sh)
    assert np.array_equal(value("opacities"), model.opacities().astype(np.float32))
    assert np.array_equal(value("scales"), model.scales())
    up = geom.Xformable(prim).GetLocalTransformation().Transform((0, -1, 0))
    assert np.allclose(up, (0, 1, 0))
