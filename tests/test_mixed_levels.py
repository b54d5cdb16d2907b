"""Streamed SOG drawn at mixed levels, as viewers do: near chunks fine, far ones coarse."""

import json
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from conftest import scene_path
from launch import run
from nanogs.errors import FormatError, NanogsError, NotEnoughMemoryError, OptionError
from nanogs.io.sog.chunks import read_chunks
from nanogs.raster.camera import Camera
from nanogs.scoring import mixed_views
from nanogs.scoring.mixed import SEAM_LOSS
from nanogs.scoring.mixed_views import loss_of, read_levels
from nanogs.views.chunk_levels import NOTHING, chosen_levels, chunk_distances
from nanogs.views.poses import look_at
from npm_packages import node, package

RATIOS = (1.0, 0.4, 0.1)


@pytest.fixture(scope="module")
def splats():
    return random_splats(900, degree=1)


@pytest.fixture(scope="module")
def stream(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stream") / "web"
    nanogs.write_levels(scene, folder, RATIOS, layout="streamed sog", chunk=40, preset="fast")
    return folder / "lod-meta.json"


# The choice of levels

LENGTHS = st.floats(-30, 30, width=32)


@st.composite
def boxes(draw):
    corners = draw(st.lists(st.tuples(*[LENGTHS] * 6), min_size=1, max_size=7))
    pairs = np.array(corners).reshape(-1, 2, 3)
    return np.sort(pairs, axis=1)


@st.composite
def cameras(draw):
    position = np.array(draw(st.tuples(LENGTHS, LENGTHS, LENGTHS)))
    angle = draw(st.floats(0, 2 * math.pi))
    target = position + [math.cos(angle), 0.3, math.sin(angle)]
    width, height, focal = draw(st.sampled_from([(64, 64, 50), (80, 40, 30), (30, 90, 200)]))
    pose = look_at(position, target, np.array([0.0, -1, 0]))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def expected_distances(boxes, camera):
    """Compute the distance of each chunk in a plain loop."""
    found = []
    half_sizes = [sorted((box[1] - box[0])[axis] / 2 for box in boxes) for axis in range(3)]
    for box in boxes:
        nearest = []
        for axis in range(3):
            typical = half_sizes[axis][len(boxes) // 2]
            half = (box[1][axis] - box[0][axis]) / 2
            shrunk = 0.75 * (half - typical) if half > typical else 0
            position = camera.position[axis]
            nearest.append(min(max(position, box[0][axis] + shrunk), box[1][axis] - shrunk))
        offset = np.array(nearest) - camera.position
        distance = math.sqrt(sum(offset**2))
        depth = float(offset @ camera.world_to_camera[2, :3])
        if distance > 1e-2 and depth < 0:
            distance *= 1 + 0.5 * -depth / distance
        tangent = min(camera.width, camera.height) / 2 / camera.fx
        found.append(distance * tangent / math.tan(math.pi / 8))
    return found


@given(boxes(), cameras())
def test_chunk_distances_follow_the_formula_of_the_engine(boxes, camera):
    assert chunk_distances(boxes, camera) == pytest.approx(
        expected_distances(boxes, camera), abs=0.02
    )


def drawn_level(counts, level):
    """Return the level to draw if `level` is chosen, where the chunk may have no splats."""
    if not any(counts[level:]):
        return NOTHING
    finer = [other for other in range(level + 1) if counts[other]]
    return finer[-1] if finer else next(other for other in range(level, 99) if counts[other])


def expected_levels(distances, counts, scale):
    """Choose the level of each chunk, with all thresholds multiplied by `scale`."""
    found = []
    for distance, each in zip(distances, counts, strict=True):
        level = 0
        while level + 1 < len(each) and distance >= scale * 5 * 3**level * (1 - 1e-12):
            level += 1
        found.append(drawn_level(each.tolist(), level))
    return found


def drawn_count(counts, choice):
    return sum(counts[chunk][level] for chunk, level in enumerate(choice) if level != NOTHING)


COUNTS = st.integers(1, 4).flatmap(
    lambda levels: st.lists(
        st.lists(st.integers(0, 50), min_size=levels, max_size=levels), min_size=1, max_size=8
    )
)
DISTANCES = st.sampled_from([0.0, 1.0, 4.999, 5.0, 7.5, 14.9, 15.0, 40.0, 45.0, 300.0, 1e5])


@given(COUNTS, st.data())
def test_without_a_budget_levels_change_at_distances_5_15_and_45(counts, data):
    counts = np.array(counts)
    distances = np.array(data.draw(st.lists(DISTANCES, min_size=len(counts), max_size=len(counts))))
    assert chosen_levels(distances, counts).tolist() == expected_levels(distances, counts, 1)


@given(COUNTS, st.integers(1, 300), st.data())
def test_a_budget_scales_all_distance_thresholds_equally(counts, budget, data):
    counts = -np.sort(-np.array(counts), axis=1)  # a coarser level never has more
    lengths = st.floats(0.1, 100)
    distances = np.array(data.draw(st.lists(lengths, min_size=len(counts), max_size=len(counts))))
    found = chosen_levels(distances, counts, budget).tolist()
    levels = counts.shape[1]
    scales = {distance / (5 * 3**level) for distance in distances for level in range(levels)}
    scales = [0.0, *sorted(scales), math.inf]
    # Where a chunk is three times as far away as another, rounding decides which is refined first.
    steps = sorted(d / 3**level for d in set(distances) for level in range(levels))
    assume(all(after > before * (1 + 1e-9) for before, after in pairwise(steps)))
    fitting = [
        s for s in scales if drawn_count(counts, expected_levels(distances, counts, s)) <= budget
    ]
    if counts[:, -1].sum() >= budget:  # as the engine does, even if a finer level fits too
        fitting = [0.0]
    assert found == expected_levels(distances, counts, max(fitting))


ENGINE = """
const at = process.argv[1], given = JSON.parse(process.argv[2]);
(async () => {
    const of = (name) => import(`file://${at}/${name}.js`);
    const { GSplatOctreeInstance } = await of('scene/gsplat-unified/gsplat-octree-instance');
    const { GSplatOctree } = await of('scene/gsplat-unified/gsplat-octree');
    const { GSplatLodTable } = await of('scene/gsplat-unified/gsplat-lod-table');
    const { GSplatBudgetBalancer } = await of('scene/gsplat-unified/gsplat-budget-balancer');
    const { GSplatPlacement } = await of('scene/gsplat-unified/gsplat-placement');
    const { GSplatParams } = await of('scene/gsplat-unified/gsplat-params');
    const { Mat4 } = await of('core/math/mat4');
    const { Vec3 } = await of('core/math/vec3');
    const flat = new Float32Array(given.boxes.flat(2));
    const nodes = given.counts.map((counts) => ({ lods: counts.map((count) => ({ count })) }));
    const octree = {
        nodes, lodLevels: given.counts[0].length, nodeBoundsMinMax: flat,
        nodeBoundsExcess: GSplatOctree._computeBoundsExcess(flat, nodes.length)
    };
    const placement = new GSplatPlacement(null, { getWorldTransform: () => new Mat4() });
    const inst = {
        octree, placement, nodeInfos: nodes.map(() => ({})), rangeMin: 0,
        lodTable: new GSplatLodTable(octree, 0, octree.lodLevels - 1)
    };
    const camera = {
        camera: { projection: 0, aspectRatio: given.aspect, fov: given.fov, horizontalFov: false },
        getPosition: () => new Vec3(...given.position), forward: new Vec3(...given.forward)
    };
    const params = { lodBehindPenalty: 1.5, lodDistanceShrink: 0.75 };
    GSplatOctreeInstance.prototype.evaluateNodeDistances.call(inst, camera, params);
    const limit = given.budget === null;
    new GSplatBudgetBalancer().balance(new Map([[0, inst]]), limit ? 1e15 : given.budget, limit);
    const found = inst.nodeInfos.map((info, number) => {
        const counts = given.counts[number];
        return counts[info.optimalLod] > 0 ? info.optimalLod : -1;
    });
    console.log(JSON.stringify(found));
})();
"""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [None, 0.3, 0.7])
def test_the_playcanvas_engine_chooses_the_same_levels(seed, share):
    """Runs the engine's own modules from its npm package."""
    folder = package("playcanvas") / "build/playcanvas/src"
    rng = np.random.default_rng(seed)
    boxes = np.sort(rng.normal(0, 20, (200, 2, 3)).astype(np.float32).astype(float), axis=1)
    counts = -np.sort(-rng.integers(0, 40, (200, 4)), axis=1)
    position = rng.normal(0, 10, 3)
    pose = look_at(position, rng.normal(0, 1, 3), np.array([0.0, -1, 0]))
    camera = Camera(90, 60, 70, 70, 45, 30, pose)
    budget = None if share is None else int(share * counts[:, 0].sum())
    engine_input = {
        "boxes": boxes.tolist(), "counts": counts.tolist(), "budget": budget, "aspect": 1.5,
        "fov": math.degrees(2 * math.atan(30 / 70)), "position": position.tolist(),
        "forward": pose[2, :3].tolist(),
    }  # fmt: skip
    theirs = json.loads(node(ENGINE, folder, json.dumps(engine_input)))
    ours = chosen_levels(chunk_distances(boxes, camera), counts, budget)
    assert ours.tolist() == theirs
    assert len(set(theirs)) > 2


# The rows that a mixture of levels draws


def test_every_splat_of_a_level_is_in_one_chunk_and_in_its_box(stream):
    chunks = read_chunks(stream)
    for level in range(len(RATIOS)):
        model = nanogs.load(stream, level=level)
        rows = np.concatenate(
            [
                np.arange(start, start + count)
                for start, count in zip(
                    chunks.starts[:, level], chunks.counts[:, level], strict=True
                )
            ]
        )
        assert sorted(rows) == list(range(len(model)))
        for chunk, (low, high) in enumerate(chunks.boxes):
            first = chunks.starts[chunk, level]
            means = model.means[first : first + chunks.counts[chunk, level]]
            assert (means >= low - 1e-3).all()
            assert (means <= high + 1e-3).all()


@settings(max_examples=20)
@given(seed=st.integers(0, 1 << 16))
def test_a_mixture_draws_each_chunk_at_its_chosen_level(stream, seed):
    levels = read_levels(stream)
    chunks, rng = levels.chunks, np.random.default_rng(seed)
    choice = rng.integers(-1, len(RATIOS), len(chunks.boxes))
    rows = levels.drawn(choice)
    for chunk, level in enumerate(choice):
        for other, start in enumerate(levels.ends[:-1]):
            first = start + chunks.starts[chunk, other]
            own = rows[first : first + chunks.counts[chunk, other]]
            assert own.all() if other == level else not own.any()
    assert rows.sum() == drawn_count(chunks.counts, choice)


@pytest.mark.parametrize("suffix", ["", ".ssog"])
def test_a_mixture_of_one_level_scores_the_same_as_that_level(scene, stream, tmp_path, suffix):
    if suffix:
        nanogs.write_levels(
            scene, tmp_path / "a.ssog", RATIOS, layout="streamed sog archive", chunk=40,
            preset="fast",
        )  # fmt: skip
        stream = tmp_path / "a.ssog"
    view_options = {"views": 2, "pixels": 64}
    for budget, level in ((10**6, 0), (1, 2)):
        [found] = nanogs.compare_mixed(scene, stream, budget=budget, **view_options).scores
        alone = nanogs.compare(scene, nanogs.load(stream, level=level), **view_options).models[0]
        assert (found.psnr, found.ssim) == (alone.psnr, alone.ssim)
        assert (found.coarse_psnr, found.coarse_ssim) == (alone.psnr, alone.ssim)
        assert {view.coarse for view in found.views} == {level}
        assert found.seam_loss is None
        assert found.seams == 0


def test_a_budget_may_be_a_numpy_number(scene, stream):
    found = nanogs.compare_mixed(scene, stream, budget=np.int64(500), views=1, pixels=32)
    assert json.loads(json.dumps(found.to_dict()))["scores"][0]["budget"] == 500


def test_the_environment_is_drawn_in_every_mixture(scene, tmp_path):
    folder = tmp_path / "web"
    nanogs.write_levels(scene, folder, RATIOS, layout="streamed sog", chunk=40, preset="fast")
    sky = random_splats(7, degree=0)
    nanogs.save(sky, folder / "sky" / "meta.json")
    described = json.loads((folder / "lod-meta.json").read_text())
    described["environment"] = "sky/meta.json"
    (folder / "lod-meta.json").write_text(json.dumps(described))
    levels = read_levels(folder / "lod-meta.json")
    assert len(levels.prepared) == sum(levels.chunks.counts.sum(axis=0)) + 7
    nothing = np.full(len(levels.chunks.boxes), NOTHING)
    assert np.flatnonzero(levels.drawn(nothing)).tolist() == list(
        range(levels.ends[-1], levels.ends[-1] + 7)
    )
    assert levels.alone(1).sum() == levels.chunks.counts[:, 1].sum() + 7


# Seams


def test_seams_are_pixels_to_which_two_levels_contribute():
    rng = np.random.default_rng(1)
    original, image, *alone = rng.random((4, 6, 5, 3)).astype(np.float32)
    shares = rng.choice([0.0, 0.05, 0.2, 0.8], (6, 5, 3)).astype(np.float32)
    share, (error, other) = mixed_views._at_seams(original, image, shares, alone)
    pixels, own_error, coarse_error = 0, 0.0, 0.0
    for row in range(6):
        for column in range(5):
            contributing = [level for level in range(3) if shares[row, column, level] >= 0.1]
            if len(contributing) > 1:
                pixels += 1
                pixel = (row, column)
                own_error += ((original[pixel].astype(float) - image[pixel]) ** 2).mean()
                coarse_error += (
                    (original[pixel].astype(float) - alone[contributing[-1] - 1][pixel]) ** 2
                ).mean()
    assert share == pytest.approx(pixels / 30)
    assert (error, other) == (pytest.approx(own_error), pytest.approx(coarse_error))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["seal.splat", "guitar.compressed.ply"])
def test_seams_of_real_scenes_are_no_worse_than_the_coarser_level(tmp_path, name):
    path = scene_path(name)
    options = {"layout": "streamed sog", "chunk": 8192, "preset": "fast"}
    manifest, _ = nanogs.write_levels(path, tmp_path / "web", [0.5, 0.25, 0.125], **options)
    found = nanogs.compare_mixed(
        path, tmp_path / "web" / "lod-meta.json", budget=manifest.levels[0].count * 2 // 3,
        cameras=["auto", "roam"], views=4, pixels=256,
    )  # fmt: skip
    for score in found.scores:
        assert score.seams > 0
        assert score.seam_loss <= SEAM_LOSS
        assert score.psnr > score.coarse_psnr


def test_the_seam_loss_is_a_ratio_of_errors_in_decibels():
    assert loss_of(2.0, 1.0) == pytest.approx(10 * math.log10(2))
    assert loss_of(0.0, 0.0) == 0
    assert loss_of(1.0, 0.0) == math.inf


# The command


def test_the_command_reports_the_levels_of_each_view(scene, stream):
    words = ["compare", scene, stream, "--mixed", "--budget", "500", "--views", 3, "--pixels", 64]
    result = run(*words, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    [score] = report["scores"]
    assert score["levels"] == [900, 360, 90]
    assert score["budget"] == 500
    for view in score["views"]:
        assert view["splats"] <= 500
        assert sum(view["chunks"]) == len(read_chunks(stream).boxes)
        assert view["coarse"] == max(level for level, n in enumerate(view["chunks"]) if n)
    assert score["seams"] > 0
    errors = [sum(v[name] for v in score["views"]) for name in ("seam_error", "seam_coarse_error")]
    assert score["seam_loss"] == pytest.approx(loss_of(*errors))
    shown = run(*words)
    assert shown.returncode == 0, shown.stderr
    assert f"{score['psnr']:.2f}" in shown.stdout + shown.stderr
    assert "at seams" in shown.stdout


def test_notes_of_reading_the_original_are_reported(scene, stream, tmp_path):
    nanogs.save(nanogs.load(scene), tmp_path / "a.ply")
    head, element, rest = (tmp_path / "a.ply").read_bytes().partition(b"\nelement ")
    (tmp_path / "a.ply").write_bytes(head + b"\nobj_info one" + element + rest)
    options = {"views": 1, "pixels": 32, "budget": 500}
    [note] = nanogs.load(tmp_path / "a.ply").notes
    assert "obj_info" in note
    assert f"a.ply: {note}" in nanogs.compare_mixed(tmp_path / "a.ply", stream, **options).notes
    in_memory = nanogs.compare_mixed(nanogs.load(tmp_path / "a.ply"), stream, **options).notes
    assert not [each for each in in_memory if "obj_info" in each]


def test_the_command_explains_why_no_levels_are_mixed(scene, stream):
    view_options = ("--views", 1, "--pixels", 32)

    def stderr_of(model, budget):
        result = run("compare", scene, model, "--mixed", "--budget", budget, *view_options)
        assert result.returncode == 0, result.stderr
        return " ".join(result.stderr.split())

    coarsest = stderr_of(stream, 1)
    assert "the coarsest level, 90 splats, exceeds the budget and is drawn" in coarsest
    assert "levels of at most 1 splat:" in coarsest
    assert "a --budget between the splats of two levels (900, 360, 90) mixes them" in stderr_of(
        stream, 360
    )
    whole = scene.with_name("whole.ssog")
    lod_result = run("lod", scene, whole, "--preset", "fast", "--levels", "0.5,0.2", "-q")
    assert lod_result.returncode == 0, lod_result.stderr
    assert "the stream is a single chunk, make it with smaller ones (--chunk)" in stderr_of(
        whole, 600
    )


def test_visible_seams_are_noted(scene, stream, monkeypatch):
    view_options = {"budget": 500, "views": 2, "pixels": 64}
    monkeypatch.setattr("nanogs.scoring.mixed.SEAM_LOSS", -99.0)
    assert any(
        "where levels meet" in note
        for note in nanogs.compare_mixed(scene, stream, **view_options).notes
    )
    monkeypatch.setattr("nanogs.scoring.mixed.SEAM_LOSS", 99.0)
    assert not nanogs.compare_mixed(scene, stream, **view_options).notes


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--budget", "500"], "--budget works only with --mixed"),
        (["--mixed", "--budget", "0"], "budget"),
        (["--mixed", "--packed", ".sog"], "--packed cannot be combined with --mixed"),
        (["--mixed", "--metrics", "flip"], "--metrics cannot be combined with --mixed"),
        (["--mixed", "--report", "a.html"], "--report cannot be combined with --mixed"),
    ],
)
def test_wrong_options_are_refused(scene, stream, tmp_path, options, message):
    result = run("compare", scene, stream, *options, cwd=tmp_path)
    assert result.returncode == 2
    assert message in " ".join(result.stderr.split())


def test_only_streams_are_mixed(scene):
    with pytest.raises(OptionError, match=r"scene\.ply has no chunks"):
        nanogs.compare_mixed(scene, scene)
    with pytest.raises(OptionError, match="at least one"):
        nanogs.compare_mixed(scene)


def test_arguments_of_the_python_function_are_checked(scene, stream):
    for names in (["a"], 2, "ab", ["a", 2]):
        with pytest.raises(OptionError, match="stream, 2 in all, not"):
            nanogs.compare_mixed(scene, stream, names=names)
    with pytest.raises(OptionError, match="1 splat or more"):
        nanogs.compare_mixed(scene, stream, budget=0)
    with pytest.raises(NanogsError, match="download the stream"):
        nanogs.compare_mixed(scene, "https://example.org/web/lod-meta.json")
    with pytest.raises(NotEnoughMemoryError, match="mixed levels"):
        nanogs.compare_mixed(scene, stream, max_memory="1MB")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda leaf: leaf.pop("bound"), "bound must be a JSON object"),
        (lambda leaf: leaf["bound"].update(min=[1, 2]), r"bound\.min must be a list of 3"),
        (lambda leaf: leaf["lods"].update({"00": {"file": 0, "offset": 0, "count": 0}}), "twice"),
    ],
)
def test_damaged_chunks_of_a_stream_are_refused(stream, tmp_path, change, message):
    described = json.loads(stream.read_text())
    leaf = described["tree"]
    while "children" in leaf:
        leaf = leaf["children"][0]
    change(leaf)
    (tmp_path / "lod-meta.json").write_text(json.dumps(described))
    with pytest.raises(FormatError, match=message):
        read_chunks(tmp_path / "lod-meta.json")
