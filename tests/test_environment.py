"""The environment of streamed SOG: detected, given, written, read, and drawn by the viewer."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from launch import run
from nanogs import filters, io, levels_of_detail
from nanogs.errors import ModelError, NotEnoughMemoryError, OptionError, OutputError
from nanogs.levels_of_detail import write_levels
from nanogs.lod import folder
from nanogs.lod.environment import find_environment
from nanogs.metrics import psnr
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import render
from nanogs.source import InMemory
from nanogs.splats import concatenate
from nanogs.views.poses import look_at
from npm_packages import package
from supersplat_page import camera_options, render_in_supersplat
from test_lod_stream import leaves
from test_rad_spark import three_clusters

SCENE, SKY = 2400, 700
FAST = ("--preset", "fast", "--chunk", "500", "--levels", "1,0.5,0.1")


def shell(count, radius, *, half=True, seed=1, degree=1, width=2.0, centre=(0, 0, 0), alpha=0.98):
    """Return splats at about one distance from the centre: a sky above (-y) or all around.

    Args:
        count: Number of splats.
        radius: The distance.
        half: Whether there are no splats below the centre.
        seed: Seed of all random numbers.
        degree: Degree of spherical harmonics.
        width: Standard deviation of a splat, relative to the one that makes the splats together
            cover the sphere once.
        centre: Centre of the shell.
        alpha: Opacity of each splat.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    if half:
        directions[:, 1] = -np.abs(directions[:, 1])
    distances = radius * rng.uniform(0.97, 1.03, (count, 1))
    deviation = width * radius * np.sqrt(2 / count)
    return replace(
        random_splats(count, degree=degree, seed=seed),
        means=(directions * distances + centre).astype(np.float32),
        log_scales=np.full((count, 3), np.log(deviation), np.float32),
        opacity_logits=np.full(count, np.log(alpha / (1 - alpha)), np.float32),
    )


def under_a_sky(radius=12.0, **options):
    """Return a scene and the sky around it, with the rows of both in random order."""
    joined = concatenate([random_splats(SCENE), shell(SKY, radius, **options)])
    return joined.take(np.random.default_rng(5).permutation(len(joined)))


def found(model):
    return find_environment(InMemory(model))


# Finding it


@pytest.mark.parametrize(
    "sky",
    [
        shell(SKY, 12),
        shell(SKY, 12, half=False),
        shell(SKY, 100, centre=(5, 0, -3)),
        shell(150, 30),  # few and wide
        shell(2000, 12, width=0.6),  # small, nearly transparent between them
        shell(SKY, 12, alpha=0.3),
    ],
)
def test_all_splats_of_a_sky_are_found(sky):
    model = concatenate([random_splats(SCENE), sky])
    environment = found(model)
    assert environment.splats == len(sky)
    assert 2 < environment.radius < 100
    keep = filters.within(environment.centre, environment.radius).keep(model)
    assert np.array_equal(np.flatnonzero(~keep), SCENE + np.arange(len(sky)))
    beyond = filters.beyond(environment.centre, environment.radius).keep(model)
    assert np.array_equal(keep, ~beyond)


def test_outliers_between_scene_and_sky_stay_in_the_scene():
    strays = random_splats(6, seed=8, spread=3.5)
    model = concatenate([random_splats(SCENE), strays, shell(SKY, 14)])
    assert found(model).splats == SKY


def on_the_ground(count, radius, seed=3):
    """Return splats on a plane, denser in the middle; `radius` scales the extent."""
    model = random_splats(count, seed=seed)
    distances = np.abs(model.means[:, :1]) ** 4 * radius
    means = np.concatenate([model.means[:, 1:2], model.means[:, :1] * 0, model.means[:, 2:]], 1)
    return replace(model, means=(means * (0.05 + distances)).astype(np.float32))


def far_house():
    model = random_splats(500, seed=4)
    return replace(model, means=(model.means + [40, 0, 0]).astype(np.float32))


NO_SKY = {
    "a scene": random_splats(SCENE),
    "one splat": random_splats(1),
    "the same place": replace(random_splats(500), means=np.ones((500, 3), np.float32)),
    "ground to the horizon": on_the_ground(5000, 200),
    "ground up to the sky": concatenate([on_the_ground(5000, 200), shell(SKY, 150)]),
    "a house far away": concatenate([random_splats(SCENE), far_house()]),
    "strays all around": concatenate([random_splats(SCENE), shell(SKY, 30, width=0.02)]),
    "a haze": concatenate([random_splats(SCENE), shell(SKY, 30, alpha=0.01)]),
    "walls around a room": concatenate([random_splats(SCENE), shell(SKY, 2.5, half=False)]),
    "walls of a hall": concatenate([random_splats(SCENE), shell(SKY, 3.75, half=False)]),
    "more sky than scene": concatenate([random_splats(SKY), shell(SCENE, 30)]),
    "a sky of which little is seen": concatenate(
        [random_splats(SCENE), shell(SKY, 30).take(shell(SKY, 30).means[:, 0] > 22)]
    ),
}


@pytest.mark.parametrize("name", NO_SKY)
def test_models_without_a_sky_have_no_environment(name):
    assert found(NO_SKY[name]) is None


@pytest.mark.parametrize(
    "name",
    [
        "biker.spz", "chair.splat", "guitar.compressed.ply", "kitchen.spz", "plant.splat",
        "seal.splat", "skull.sog", "flowers/lod-meta.json", "playbot/lod-meta.json",
    ],
)  # fmt: skip
def test_real_scenes_without_a_sky_have_no_environment(name):
    with io.open(scene_path(name)) as source:
        assert find_environment(source) is None


@given(seed=st.integers(0, 99), power=st.integers(-20, 20), shift=st.integers(-3, 3))
def test_the_environment_does_not_depend_on_units_position_or_order(seed, power, shift):
    model = under_a_sky(20)
    original = found(model)
    order = np.random.default_rng(seed).permutation(len(model))
    moved = replace(
        model.take(order),
        means=((model.means[order] + shift) * np.float32(2.0**power)).astype(np.float32),
        log_scales=(model.log_scales[order] + np.float32(power * np.log(2))).astype(np.float32),
    )
    changed = found(moved)
    assert changed.splats == original.splats == SKY
    assert np.isclose(changed.radius, original.radius * 2.0**power, rtol=1e-4)


def test_nonfinite_splats_do_not_affect_the_environment():
    model = under_a_sky()
    means, scales = model.means.copy(), model.log_scales.copy()
    means[0], scales[1] = np.nan, np.inf
    damaged = replace(model, means=means, log_scales=scales)
    environment = found(damaged)
    assert environment.splats in (SKY, SKY - 1, SKY - 2)
    keep = filters.within(environment.centre, environment.radius).keep(damaged)
    assert keep[0]  # it is dropped later, with the other nonfinite splats


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_splats_with_a_nonfinite_centre_stay_in_the_scene(value):
    model = random_splats(3)
    model.means[1, 2] = value
    assert filters.within((0, 0, 0), 1e-6).keep(model).tolist() == [False, True, False]
    assert filters.beyond((0, 0, 0), 1e-6).keep(model).tolist() == [True, False, True]


# Writing it


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("sky") / "a.ply"
    nanogs.save(under_a_sky(), path)
    return path


@pytest.fixture(scope="module")
def written_levels(model):
    """The folder of a streamed SOG and an archive of it, the report, and the messages."""
    parent = model.parent
    result = run("lod", model, parent / "web" / "lod-meta.json", *FAST, "--json")
    assert result.returncode == 0, result.stderr
    archive = run("lod", model, parent / "a.ssog", *FAST)
    assert archive.returncode == 0, archive.stderr
    return parent, json.loads(result.stdout), archive.stderr


def test_each_splat_is_either_in_the_levels_or_in_the_environment(model, written_levels):
    parent, report, _ = written_levels
    meta = json.loads((parent / "web" / "lod-meta.json").read_text())
    assert meta["environment"] == "env/meta.json"
    assert meta["counts"] == [2400, 1200, 240]
    assert sum(leaf["lods"]["0"]["count"] for leaf in leaves(meta["tree"])) == SCENE
    assert not any("env" in name for name in meta["filenames"])
    sky, original = io.load(parent / "web" / "env" / "meta.json"), io.load(model)
    assert len(sky) == SKY
    assert np.linalg.norm(sky.means, axis=1).min() > 11
    for level, scene in enumerate((2400, 1200, 240)):
        loaded = io.load(parent / "web" / "lod-meta.json", level=level)
        assert (np.linalg.norm(loaded.means, axis=1) > 6).sum() == SKY
        assert len(loaded) == scene + SKY
        if level == 0:
            assert np.allclose(np.sort(loaded.means, 0), np.sort(original.means, 0), atol=0.1)
    boxes = np.array([[meta["tree"]["bound"][end] for end in ("min", "max")]])
    assert np.abs(boxes).max() < 6  # the sky is not in the boxes
    assert report["environment"] == {
        "source": "auto", "count": SKY,
        "bytes": sum(file.stat().st_size for file in (parent / "web" / "env").iterdir()),
        "requests": len(list((parent / "web" / "env").iterdir())),
    }  # fmt: skip
    assert report["source_count"] == len(original)
    assert report["filters"] == []


def test_the_first_picture_includes_requests_for_the_environment(written_levels):
    parent, report, messages = written_levels
    assert f"an environment of {SKY} splats, separated from the model" in messages
    with zipfile.ZipFile(parent / "a.ssog") as archive:
        names = archive.namelist()
        assert {name: archive.read(name) for name in names} == {
            path.relative_to(parent / "web").as_posix(): path.read_bytes()
            for path in (parent / "web").rglob("*")
            if path.is_file()
        }
    order = [name.split("/")[0] for name in names]
    assert list(dict.fromkeys(order)) == ["lod-meta.json", "env", "2_0", "1_0", "0_0", "0_1"]
    result = run("lod", parent / "a.ply", parent / "web" / "lod-meta.json", *FAST, "-w")
    requests = 1 + report["environment"]["requests"] + report["levels"][-1]["requests"]
    assert f"first picture takes {requests} requests" in result.stderr


def test_a_dry_run_reports_the_environment(model, tmp_path):
    path = tmp_path / "web" / "lod-meta.json"
    plan = json.loads(run("lod", model, path, *FAST, "--dry-run", "--json").stdout)
    assert plan["environment"] == {"source": "auto", "count": SKY}
    assert [level["count"] for level in plan["levels"]] == [2400, 1200, 240]
    assert (plan["read_count"], plan["input_count"]) == (2400 + SKY, 2400)
    messages = run("lod", model, path, *FAST, "--dry-run", "--job", tmp_path / "job").stderr
    assert f"an environment of {SKY} splats" in " ".join(messages.split())
    assert f"a.ply ({2400 + SKY:,} splats, of which 2,400 remain, SH degree" in messages
    plan = run("lod", model, path, *FAST, "--dry-run", "--json", "--environment", "none").stdout
    assert json.loads(plan)["environment"] is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("more", [(), ("--dry-run",), ("--job", "job")])
def test_a_ratio_for_an_environment_that_is_not_there_is_noted(model, tmp_path, more):
    whole = io.load(model)
    io.save(whole.take(np.linalg.norm(whole.means, axis=1) < 6), tmp_path / "a.ply")
    more = [tmp_path / each if each == "job" else each for each in more]
    for ratio, noted in (("0.5", True), ("1", False)):
        out = tmp_path / ratio / "lod-meta.json"
        options = (*FAST, "--environment-ratio", ratio, *more, "-w")
        result = run("lod", tmp_path / "a.ply", out, *options)
        assert result.returncode == 0, result.stderr
        assert ("environment's ratio has no effect" in " ".join(result.stderr.split())) == noted


def test_environment_none_leaves_all_splats_in_the_levels(model, tmp_path):
    path = tmp_path / "web" / "lod-meta.json"
    result = run("lod", model, path, *FAST, "--environment", "none", "--json")
    assert json.loads(result.stdout)["environment"] is None
    assert io.open(path).levels == (3100, 1550, 310)
    assert "environment" not in json.loads(path.read_text())
    plain = run("lod", model, tmp_path / "plain", "--preset", "fast", "--levels", "1", "--json")
    assert json.loads(plain.stdout)["levels"][0]["count"] == 3100  # files have no environment


def test_another_model_can_be_the_environment(model, tmp_path):
    other = shell(400, 40, degree=3, seed=6)
    nanogs.save(other, tmp_path / "b.sog")
    path = tmp_path / "web" / "lod-meta.json"
    options = ["--environment", tmp_path / "b.sog", "--environment-ratio", "0.25"]
    result = run("lod", model, path, *FAST, *options, "--json")
    assert result.returncode == 0, result.stderr
    sky = json.loads(result.stdout)["environment"]
    assert (sky["source"], sky["count"]) == ("b.sog", 100)
    assert io.open(path).levels == (3200, 1650, 410)
    loaded = io.load(path)
    assert (loaded.sh_degree, len(loaded)) == (3, 3200)
    overwritten = run("lod", model, path, *FAST, "-w", "--environment", "none")
    assert overwritten.returncode == 0, overwritten.stderr  # recognises env/ as its own
    assert not (path.parent / "env").exists()


@pytest.mark.parametrize("sky", ["auto", "given"])
def test_blocks_make_the_same_environment_for_any_number_of_threads(model, tmp_path, sky):
    options = {"preset": "fast", "layout": "streamed sog archive", "chunk": 500}
    if sky == "given":
        options |= {"environment": shell(300, 30), "environment_ratio": 0.5}
    for number in (1, 2):
        manifest, reports = write_levels(
            model, tmp_path / f"{number}.ssog", [1, 0.5, 0.1], threads=number, block=1000, **options
        )
    assert (tmp_path / "1.ssog").read_bytes() == (tmp_path / "2.ssog").read_bytes()
    assert reports[0].blocks.blocks > 1
    assert (manifest.source_count, reports[0].filters) == (3100, ())
    write_levels(model, tmp_path / "whole.ssog", [1, 0.5, 0.1], **options)
    with (
        zipfile.ZipFile(tmp_path / "1.ssog") as of_blocks,
        zipfile.ZipFile(tmp_path / "whole.ssog") as of_whole,
    ):
        names = [name for name in of_blocks.namelist() if name.startswith("env/")]
        assert names == [name for name in of_whole.namelist() if name.startswith("env/")]
        assert all(of_blocks.read(name) == of_whole.read(name) for name in names)
    scene_counts = (3100, 1550, 310) if sky == "given" else (2400, 1200, 240)
    environment_count = 150 if sky == "given" else SKY
    assert io.open(tmp_path / "1.ssog").levels == tuple(
        count + environment_count for count in scene_counts
    )


def test_an_interrupted_job_resumes_to_the_same_bytes(model, tmp_path, monkeypatch):
    """Interrupted before and while the environment is written; another environment is refused."""
    options = {"preset": "fast", "layout": "streamed sog archive", "chunk": 500, "block": 1000}
    write_levels(model, tmp_path / "a.ssog", [1, 0.1], **options)
    original, names_that_fail = folder.ChunksFilling._write, ["env/sh0.webp", "env/meta.json"]

    def interrupted_write(self, name, data):
        if name in names_that_fail:
            names_that_fail.remove(name)
            raise KeyboardInterrupt
        original(self, name, data)

    monkeypatch.setattr(folder.ChunksFilling, "_write", interrupted_write)
    with pytest.raises(KeyboardInterrupt):
        write_levels(model, tmp_path / "b.ssog", [1, 0.1], **options)
    with pytest.raises(OutputError, match=r"differs: the filters, `environment`\)"):
        write_levels(
            model, tmp_path / "b.ssog", [1, 0.1], resume=True, environment="none", **options
        )
    other = shell(300, 30)
    with pytest.raises(OutputError, match=r"differs: .*`environment`\)"):
        write_levels(
            model, tmp_path / "b.ssog", [1, 0.1], resume=True, environment=other, **options
        )
    with pytest.raises(KeyboardInterrupt):
        write_levels(model, tmp_path / "b.ssog", [1, 0.1], resume=True, **options)
    write_levels(model, tmp_path / "b.ssog", [1, 0.1], resume=True, **options)
    assert names_that_fail == []
    assert (tmp_path / "b.ssog").read_bytes() == (tmp_path / "a.ssog").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ssog", "b.ssog"]


def test_the_environment_gets_the_same_edits_as_the_levels(model, written_levels, tmp_path):
    path = tmp_path / "web" / "lod-meta.json"
    edits = ["--frame", "rdf:rub", "--sh-degree", "0", "--min-opacity", "0.05"]
    result = run("lod", model, path, *FAST, *edits, "--json")
    assert result.returncode == 0, result.stderr
    assert [entry["name"] for entry in json.loads(result.stdout)["filters"]] == ["min-opacity"]
    sky = io.load(path.parent / "env" / "meta.json")
    unedited = io.load(written_levels[0] / "web" / "env" / "meta.json")
    assert sky.sh_degree == 0
    assert np.allclose(sky.means.mean(0), unedited.means.mean(0) * [1, -1, -1], atol=0.01)
    assert len(io.load(path)) < 3100


@pytest.mark.parametrize("block", [None, 1000])
def test_levels_are_measured_together_with_their_environment(
    model, tmp_path, block, small_pictures
):
    """The finest level has all splats, whether the sky is part of the model or another model."""
    options = {"preset": "fast", "layout": "streamed sog archive", "measured": True}
    options |= {"block": block} if block else {}
    for environment in ("auto", shell(300, 30)):
        manifest, _ = write_levels(
            model, tmp_path / "a.ssog", [1, 0.1], environment=environment, overwrite=True, **options
        )
        fine, coarse = (level.psnr for level in manifest.levels)
        assert fine > 30 > coarse


@pytest.mark.parametrize(
    ("name", "options", "fragments"),
    [
        ("out/lod-meta.json", ["--environment", "gone.ply"], ["gone.ply", "no such file"]),
        ("out/lod-meta.json", ["--environment", "https://a.b/c.ply"], ["is a URL", "name a file"]),
        ("out/lod-meta.json", ["--environment-ratio", "2"], ["at most 1, not 2"]),
        ("out/lod-meta.json", ["--environment-ratio", "0"], ["above 0"]),
        (
            "out/lod-meta.json",
            ["--environment-ratio", "150%"],
            ["ratio takes 100% or less, not '150%'"],
        ),
        (
            "out/lod-meta.json",
            ["--environment", "none", "--environment-ratio", "0.5"],
            ["no environment to simplify"],
        ),
        (
            "out/tileset.json",
            ["--environment", "gone.ply"],
            ["Only streamed SOG can have an environment"],
        ),
        ("out", ["--environment-ratio", "0.5"], ["Only streamed SOG can have an environment"]),
        ("out.rad", ["--environment", "a.ply"], ["Only streamed SOG can have an environment"]),
    ],
)
def test_impossible_environment_options_are_refused(model, tmp_path, name, options, fragments):
    result = run("lod", model, tmp_path / name, "--preset", "fast", *options)
    assert result.returncode == 2
    assert all(word in " ".join(result.stderr.split()) for word in fragments), result.stderr
    assert list(tmp_path.iterdir()) == []


def test_parts_left_out_of_the_environment_are_noted(tmp_path):
    options = {"layout": "streamed sog archive", "preset": "fast"}
    sky = shell(300, 30)
    means = sky.means.copy()
    means[:2] = np.nan
    labelled = replace(sky, means=means, extras={"label": np.arange(300)})
    manifest, _ = write_levels(
        random_splats(30), tmp_path / "a.ssog", [1], environment=labelled, environment_ratio=0.5,
        **options,
    )  # fmt: skip
    assert manifest.environment.count == 149
    assert (
        "Left out of the environment: 2 splats with a NaN or an infinite value." in manifest.notes
    )
    assert any("The environment: Extra columns" in note for note in manifest.notes)
    for nan, rows in (("error", 300), ("drop", 2)):
        with pytest.raises(
            ModelError, match="The environment, a model, cannot be used: 2 splats hold a NaN"
        ):
            write_levels(
                random_splats(30), tmp_path / "b.ssog", [1], nan=nan,
                environment=labelled.take(np.arange(rows)), **options,
            )  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["a.ssog"]


@pytest.mark.parametrize("sky", ["model", "path"])
@pytest.mark.parametrize("scene", ["memory", "file", "blocks"])
def test_an_environment_of_another_render_mode_is_refused(tmp_path, scene, sky):
    """And accepted if a render mode is set for both."""
    model, environment = replace(random_splats(300), render_mode="mip"), shell(100, 30)
    nanogs.save(model, tmp_path / "a.ply")
    nanogs.save(environment, tmp_path / "sky.ply")
    options = {"layout": "streamed sog", "preset": "fast"}
    options["block"] = 100 if scene == "blocks" else None
    options["environment"] = environment if sky == "model" else tmp_path / "sky.ply"
    given = model if scene == "memory" else tmp_path / "a.ply"
    with pytest.raises(ModelError, match=r"different render modes \(mip and default\) .*`render_m"):
        write_levels(given, tmp_path / "lv", [1], **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "sky.ply"]
    write_levels(given, tmp_path / "lv", [1], render_mode="mip", **options)
    assert nanogs.load(tmp_path / "lv" / "lod-meta.json").render_mode == "mip"


@pytest.mark.parametrize("block", [None, 100])
def test_an_environment_in_another_frame_is_refused(tmp_path, block):
    for frame in ("rub", "rdf"):
        options = {"spz_version": 4, "frame": frame}
        nanogs.save(random_splats(300), tmp_path / f"{frame}.spz", format_options=options)
    for name in ("none.spz", "a.glb"):
        nanogs.save(shell(100, 30), tmp_path / name)
    options = {"layout": "streamed sog", "preset": "fast", "block": block}
    place, model = tmp_path / "lv", tmp_path / "rub.spz"
    for sky, frame in (("rdf.spz", None), ("a.glb", ("rub", "rdf"))):
        with pytest.raises(ModelError, match=r"is in the frame rub and .* in rdf, so they cannot"):
            write_levels(model, place, [1], environment=tmp_path / sky, frame=frame, **options)
    assert not place.exists()
    manifest, _ = write_levels(model, place, [1], environment=tmp_path / "none.spz", **options)
    said = f"Taken to be in the frame rub, as {model} is: {tmp_path / 'none.spz'}."
    assert said in manifest.notes


def test_an_environment_is_in_the_frame_from_which_a_model_in_memory_is_turned(tmp_path):
    nanogs.save(shell(100, 30), tmp_path / "a.glb")
    options = {"layout": "streamed sog", "preset": "fast", "environment": tmp_path / "a.glb"}
    with pytest.raises(OptionError, match=r"a\.glb is turned to rdf when it is read"):
        write_levels(random_splats(30), tmp_path / "lv", [1], frame=("rub", "rdf"), **options)


@pytest.fixture
def broken(tmp_path):
    """A file of a model with a sky of which 100 splats have no scale."""
    sky = shell(SKY, 12)
    sky.log_scales[:100] = np.nan
    nanogs.save(concatenate([random_splats(SCENE), sky]), tmp_path / "broken.ply")
    return tmp_path / "broken.ply"


@pytest.mark.parametrize("given", ["memory", "file", "blocks", "named", "named in blocks"])
def test_nonfinite_environments_are_refused_before_any_work(broken, tmp_path, monkeypatch, given):
    for name in ("requested_levels", "fill_in_blocks"):
        monkeypatch.setattr(levels_of_detail, name, None)
    options = {"layout": "streamed sog", "preset": "fast", "nan": "error"}
    options["block"] = 1000 if "blocks" in given else None
    model, reason = broken, r"100 splats of its environment hold a NaN .* `nan=\"drop\"`"
    if given == "memory":
        model = nanogs.load(broken)
    elif "named" in given:
        model, reason = tmp_path / "a.ply", r"broken\.ply, cannot be used: 100 splats hold a NaN"
        nanogs.save(random_splats(300), model)
        options["environment"] = broken
    with pytest.raises(ModelError, match=reason):
        write_levels(model, tmp_path / "lv", [1], **options)


def test_blocks_count_nonfinite_splats_of_the_environment_too(broken, tmp_path):
    options = {"layout": "streamed sog", "preset": "fast", "chunk": 500}
    whole, _ = write_levels(broken, tmp_path / "whole", [1], **options)
    blocks, _ = write_levels(broken, tmp_path / "blocks", [1], block=1000, **options)
    assert whole.source_count == blocks.source_count == SCENE + SKY
    assert whole.environment == blocks.environment
    assert whole.environment.count == SKY - 100


@pytest.mark.parametrize("environment", [None, 3])
def test_what_is_no_environment_is_refused(tmp_path, environment):
    with pytest.raises(OptionError, match='"none" for no environment, a path or a model, not'):
        write_levels(
            random_splats(9), tmp_path / "lv", [1], layout="streamed sog", environment=environment
        )


def test_parts_of_different_render_modes_are_noted_when_read(tmp_path):
    options = {"layout": "streamed sog", "preset": "fast", "render_mode": "mip"}
    write_levels(random_splats(30), tmp_path / "lv", [1], environment=shell(100, 30), **options)
    path, sky = tmp_path / "lv" / "lod-meta.json", tmp_path / "lv" / "env" / "meta.json"
    assert nanogs.load(path).render_mode == "mip"
    assert nanogs.load(path).notes == ()
    untagged = json.loads(sky.read_text())
    del untagged["model"]
    sky.write_text(json.dumps(untagged))
    read = nanogs.load(path)
    assert read.render_mode == "default"
    [note] = read.notes
    assert "different render modes (default, mip), and all are taken for default" in note


def test_an_environment_too_large_for_memory_is_refused_before_any_work(tmp_path):
    big = concatenate([random_splats(120_000, degree=3), shell(100_000, 12, degree=3)])
    nanogs.save(big, tmp_path / "a.ply")
    with pytest.raises(NotEnoughMemoryError, match=r'environment, 100,000 .*environment="none"'):
        write_levels(
            tmp_path / "a.ply", tmp_path / "a.ssog", [1], layout="streamed sog archive",
            preset="fast", max_memory="380MB", block=20_000,
        )  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


# Other programs


def test_an_environment_written_by_splat_transform_is_read(tmp_path, benchmark_module):
    package("@playcanvas/splat-transform")
    scene, sky = random_splats(SCENE), shell(300, 30)
    for name, part in (("a", scene), ("b", sky)):
        nanogs.save(part, tmp_path / f"{name}.ply")
    path = tmp_path / "out" / "lod-meta.json"
    tagged = [tmp_path / "a.ply", "-l", "0", tmp_path / "b.ply", "-l", "-1"]
    benchmark_module("rivals").run_tool(*tagged, path)
    with io.open(path) as source:
        assert (source.levels, source.environment) == ((SCENE + 300,), 300)
        loaded = source.load()
    assert (np.linalg.norm(loaded.means, axis=1) > 20).sum() == 300


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the browser driver emits warnings of its own
def test_supersplat_fetches_the_environment_once_and_renders_it_in_place(tmp_path):
    """It is fetched first, and the picture of scene and sky equals the one that nanogs renders."""
    scene, sky = three_clusters(900), shell(700, 30, half=False, degree=2)
    sh, above = np.zeros_like(sky.sh), sky.means[:, 1:2] < 0
    sh[:, 0] = np.where(above, [-1, 0, 1.2], [0.2, 0.6, -1.2]) + 0.5 * (sky.means[:, :1] > 0)
    nanogs.save(concatenate([scene, replace(sky, sh=sh)]), tmp_path / "a.ply")
    path, pages = tmp_path / "web" / "lod-meta.json", tmp_path / "own"
    options = ["--preset", "fast", "--chunk", "200", "--levels", "1,0.5"]
    assert run("lod", tmp_path / "a.ply", path, *options).returncode == 0
    pages.mkdir()
    focal = 160 / np.tan(np.radians(25))
    pose = look_at(np.array([-2.0, -1, 4]), np.zeros(3), np.array([0.0, -1, 0]))
    camera = Camera(320, 240, focal, focal, 160, 120, pose, near=0.01)
    picture, requests = render_in_supersplat(path, pages, 900 + 700, **camera_options(camera))
    assert requests[0] == "scene/lod-meta.json"
    assert "scene/env/meta.json" in requests[1:3]  # may come together with a level
    assert {"scene/0_0/meta.json", "scene/1_0/meta.json"} <= set(requests)
    assert len(requests) == len(set(requests))  # nothing is fetched twice
    rendered = render(io.load(path), camera).shown()
    assert psnr(picture, rendered) > 25
    without_sky = render(io.load(path).take(np.arange(900)), camera).shown()
    for other in (without_sky, rendered[::-1], rendered[:, ::-1], rendered[..., ::-1]):
        assert psnr(picture, other) < 20
