"""Streams as viewers draw them: near chunks fine, far ones coarse."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
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
    at = np.array(draw(st.tuples(LENGTHS, LENGTHS, LENGTHS)))
    angle = draw(st.floats(0, 2 * math.pi))
    towards = at + [math.cos(angle), 0.3, math.sin(angle)]
    width, height, focal = draw(st.sampled_from([(64, 64, 50), (80, 40, 30), (30, 90, 200)]))
    pose = look_at(at, towards, np.array([0.0, -1, 0]))
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def by_hand_far(boxes, camera):
    """How far away each chunk counts as, one after the other."""
    found = []
    usual = [sorted((box[1] - box[0])[axis] / 2 for box in boxes) for axis in range(3)]
    for box in boxes:
        nearest = []
        for axis in range(3):
            typical = usual[axis][len(boxes) // 2]
            half = (box[1][axis] - box[0][axis]) / 2
            less = 0.75 * (half - typical) if half > typical else 0
            at = camera.position[axis]
            nearest.append(min(max(at, box[0][axis] + less), box[1][axis] - less))
        to = np.array(nearest) - camera.position
        far = math.sqrt(sum(to**2))
        along = float(to @ camera.world_to_camera[2, :3])
        if far > 1e-2 and along < 0:
            far *= 1 + 0.5 * -along / far
        tangent = min(camera.width, camera.height) / 2 / camera.fx
        found.append(far * tangent / math.tan(math.pi / 8))
    return found


@given(boxes(), cameras())
def test_chunks_are_as_far_as_the_engine_says(boxes, camera):
    assert chunk_distances(boxes, camera) == pytest.approx(by_hand_far(boxes, camera), abs=0.02)


def due(counts, level):
    """The level of a chunk that is drawn where one is due of which it may have nothing."""
    if not any(counts[level:]):
        return NOTHING
    finer = [other for other in range(level + 1) if counts[other]]
    return finer[-1] if finer else next(other for other in range(level, 99) if counts[other])


def by_hand(distances, counts, scale):
    """The level of each chunk, where all distances are so many times as long."""
    found = []
    for far, each in zip(distances, counts, strict=True):
        level = 0
        while level + 1 < len(each) and far >= scale * 5 * 3**level * (1 - 1e-12):
            level += 1
        found.append(due(each.tolist(), level))
    return found


def spent(counts, choice):
    return sum(counts[chunk][level] for chunk, level in enumerate(choice) if level != NOTHING)


COUNTS = st.integers(1, 4).flatmap(
    lambda levels: st.lists(
        st.lists(st.integers(0, 50), min_size=levels, max_size=levels), min_size=1, max_size=8
    )
)
FAR = st.sampled_from([0.0, 1.0, 4.999, 5.0, 7.5, 14.9, 15.0, 40.0, 45.0, 300.0, 1e5])


@given(COUNTS, st.data())
def test_by_distance_alone_levels_come_at_five_fifteen_and_forty_five(counts, data):
    counts = np.array(counts)
    distances = np.array(data.draw(st.lists(FAR, min_size=len(counts), max_size=len(counts))))
    assert chosen_levels(distances, counts).tolist() == by_hand(distances, counts, 1)


@given(COUNTS, st.integers(1, 300), st.data())
def test_a_budget_stretches_all_distances_alike(counts, budget, data):
    counts = -np.sort(-np.array(counts), axis=1)  # a coarser level has no more
    near = st.floats(0.1, 100)
    distances = np.array(data.draw(st.lists(near, min_size=len(counts), max_size=len(counts))))
    found = chosen_levels(distances, counts, budget).tolist()
    levels = counts.shape[1]
    scales = {far / (5 * 3**level) for far in distances for level in range(levels)}
    scales = [0.0, *sorted(scales), math.inf]
    fitting = [s for s in scales if spent(counts, by_hand(distances, counts, s)) <= budget]
    if counts[:, -1].sum() >= budget:  # as the engine says, whatever finer levels have
        fitting = [0.0]
    assert found == by_hand(distances, counts, max(fitting))


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
def test_the_engine_itself_chooses_the_same(seed, share):
    """Its own modules, as the npm package has them."""
    at = package("playcanvas") / "build/playcanvas/src"
    rng = np.random.default_rng(seed)
    boxes = np.sort(rng.normal(0, 20, (200, 2, 3)).astype(np.float32).astype(float), axis=1)
    counts = -np.sort(-rng.integers(0, 40, (200, 4)), axis=1)
    position = rng.normal(0, 10, 3)
    pose = look_at(position, rng.normal(0, 1, 3), np.array([0.0, -1, 0]))
    camera = Camera(90, 60, 70, 70, 45, 30, pose)
    budget = None if share is None else int(share * counts[:, 0].sum())
    given = {
        "boxes": boxes.tolist(), "counts": counts.tolist(), "budget": budget, "aspect": 1.5,
        "fov": math.degrees(2 * math.atan(30 / 70)), "position": position.tolist(),
        "forward": pose[2, :3].tolist(),
    }  # fmt: skip
    theirs = json.loads(node(ENGINE, at, json.dumps(given)))
    ours = chosen_levels(chunk_distances(boxes, camera), counts, budget)
    assert ours.tolist() == theirs
    assert len(set(theirs)) > 2


# The rows of a mixture


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
def test_a_mixture_has_each_region_from_one_level(stream, seed):
    together = read_levels(stream)
    chunks, rng = together.chunks, np.random.default_rng(seed)
    choice = rng.integers(-1, len(RATIOS), len(chunks.boxes))
    rows = together.drawn(choice)
    for chunk, level in enumerate(choice):
        for other, start in enumerate(together.ends[:-1]):
            first = start + chunks.starts[chunk, other]
            own = rows[first : first + chunks.counts[chunk, other]]
            assert own.all() if other == level else not own.any()
    assert rows.sum() == spent(chunks.counts, choice)


@pytest.mark.parametrize("suffix", ["", ".ssog"])
def test_one_level_everywhere_is_that_level(scene, stream, tmp_path, suffix):
    if suffix:
        nanogs.write_levels(
            scene, tmp_path / "a.ssog", RATIOS, layout="streamed sog archive", chunk=40,
            preset="fast",
        )  # fmt: skip
        stream = tmp_path / "a.ssog"
    looks = {"views": 2, "pixels": 64}
    for budget, level in ((10**6, 0), (1, 2)):
        [found] = nanogs.compare_mixed(scene, stream, budget=budget, **looks).scores
        alone = nanogs.compare(scene, nanogs.load(stream, level=level), **looks).models[0]
        assert (found.psnr, found.ssim) == (alone.psnr, alone.ssim)
        assert (found.coarse_psnr, found.coarse_ssim) == (alone.psnr, alone.ssim)
        assert {view.coarse for view in found.views} == {level}
        assert found.seam_loss is None
        assert found.seams == 0


def test_an_environment_belongs_to_every_mixture(scene, stream, tmp_path):
    folder = tmp_path / "web"
    nanogs.write_levels(scene, folder, RATIOS, layout="streamed sog", chunk=40, preset="fast")
    sky = random_splats(7, degree=0)
    nanogs.save(sky, folder / "sky" / "meta.json")
    described = json.loads((folder / "lod-meta.json").read_text())
    described["environment"] = "sky/meta.json"
    (folder / "lod-meta.json").write_text(json.dumps(described))
    together = read_levels(folder / "lod-meta.json")
    assert len(together.prepared) == sum(together.chunks.counts.sum(axis=0)) + 7
    nothing = np.full(len(together.chunks.boxes), NOTHING)
    assert np.flatnonzero(together.drawn(nothing)).tolist() == list(
        range(together.ends[-1], together.ends[-1] + 7)
    )
    assert together.alone(1).sum() == together.chunks.counts[:, 1].sum() + 7


# Seams


def test_seams_are_where_two_levels_give_light():
    rng = np.random.default_rng(1)
    original, image, *alone = rng.random((4, 6, 5, 3)).astype(np.float32)
    shares = rng.choice([0.0, 0.05, 0.2, 0.8], (6, 5, 3)).astype(np.float32)
    share, (error, other) = mixed_views._at_seams(original, image, shares, alone)
    places, own, coarse = 0, 0.0, 0.0
    for row in range(6):
        for column in range(5):
            there = [level for level in range(3) if shares[row, column, level] >= 0.1]
            if len(there) > 1:
                places += 1
                at = (row, column)
                own += ((original[at].astype(float) - image[at]) ** 2).mean()
                coarse += ((original[at].astype(float) - alone[there[-1] - 1][at]) ** 2).mean()
    assert share == pytest.approx(places / 30)
    assert (error, other) == (pytest.approx(own), pytest.approx(coarse))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["seal.splat", "guitar.compressed.ply"])
def test_seams_of_real_scenes_are_no_worse_than_the_coarser_level(tmp_path, name):
    path = scene_path(name)
    given = {"layout": "streamed sog", "chunk": 8192, "preset": "fast"}
    made, _ = nanogs.write_levels(path, tmp_path / "web", [0.5, 0.25, 0.125], **given)
    found = nanogs.compare_mixed(
        path, tmp_path / "web" / "lod-meta.json", budget=made.levels[0].count * 2 // 3,
        cameras=["auto", "roam"], views=4, pixels=256,
    )  # fmt: skip
    for score in found.scores:
        assert score.seams > 0
        assert score.seam_loss <= SEAM_LOSS
        assert score.psnr > score.coarse_psnr


def test_a_loss_is_a_ratio_of_errors():
    assert loss_of(2.0, 1.0) == pytest.approx(10 * math.log10(2))
    assert loss_of(0.0, 0.0) == 0
    assert loss_of(1.0, 0.0) == math.inf


# The command


def test_the_command_says_what_each_view_draws(scene, stream):
    given = ["compare", scene, stream, "--mixed", "--budget", "500", "--views", 3, "--pixels", 64]
    result = run(*given, "--json")
    assert result.returncode == 0, result.stderr
    said = json.loads(result.stdout)
    [score] = said["scores"]
    assert score["levels"] == [900, 360, 90]
    assert score["budget"] == 500
    for view in score["views"]:
        assert view["splats"] <= 500
        assert sum(view["chunks"]) == len(read_chunks(stream).boxes)
        assert view["coarse"] == max(level for level, n in enumerate(view["chunks"]) if n)
    assert score["seams"] > 0
    errors = [sum(v[name] for v in score["views"]) for name in ("seam_error", "seam_coarse_error")]
    assert score["seam_loss"] == pytest.approx(loss_of(*errors))
    shown = run(*given)
    assert shown.returncode == 0, shown.stderr
    assert f"{score['psnr']:.2f}" in shown.stdout + shown.stderr
    assert "at seams" in shown.stdout


def test_what_hinders_mixing_is_said(scene, stream):
    looks = ("--views", 1, "--pixels", 32)

    def said(model, budget):
        result = run("compare", scene, model, "--mixed", "--budget", budget, *looks)
        assert result.returncode == 0, result.stderr
        return " ".join(result.stderr.split())

    least = said(stream, 1)
    assert "the coarsest level, 90 splats, exceeds the budget and is drawn" in least
    assert "levels of at most 1 splat:" in least
    assert "a --budget between the splats of two levels (900, 360, 90) mixes them" in said(
        stream, 360
    )
    whole = scene.with_name("whole.ssog")
    made = run("lod", scene, whole, "--preset", "fast", "--levels", "0.5,0.2", "-q")
    assert made.returncode == 0, made.stderr
    assert "the stream is a single chunk, make it with smaller ones (--chunk)" in said(whole, 600)


def test_a_seam_that_is_seen_is_said(scene, stream, monkeypatch):
    looks = {"budget": 500, "views": 2, "pixels": 64}
    monkeypatch.setattr("nanogs.scoring.mixed.SEAM_LOSS", -99.0)
    assert any(
        "where levels meet" in note for note in nanogs.compare_mixed(scene, stream, **looks).notes
    )
    monkeypatch.setattr("nanogs.scoring.mixed.SEAM_LOSS", 99.0)
    assert not nanogs.compare_mixed(scene, stream, **looks).notes


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--budget", "500"], "--budget works only with --mixed"),
        (["--mixed", "--budget", "0"], "budget"),
        (["--mixed", "--packed", ".sog"], "--packed cannot be combined with --mixed"),
        (["--mixed", "--metrics", "flip"], "--metrics cannot be combined with --mixed"),
        (["--mixed", "--report", "a.html"], "--report cannot be combined with --mixed"),
    ],
)
def test_refused(scene, stream, tmp_path, options, words):
    result = run("compare", scene, stream, *options, cwd=tmp_path)
    assert result.returncode == 2
    assert words in " ".join(result.stderr.split())


def test_only_streams_are_mixed(scene):
    with pytest.raises(OptionError, match=r"scene\.ply has no chunks"):
        nanogs.compare_mixed(scene, scene)
    with pytest.raises(OptionError, match="at least one"):
        nanogs.compare_mixed(scene)


def test_what_is_asked_of_python_is_checked(scene, stream):
    with pytest.raises(OptionError, match="2 in all"):
        nanogs.compare_mixed(scene, stream, names=["a"])
    with pytest.raises(OptionError, match="1 splat or more"):
        nanogs.compare_mixed(scene, stream, budget=0)
    with pytest.raises(NanogsError, match="download the stream"):
        nanogs.compare_mixed(scene, "https://example.org/web/lod-meta.json")
    with pytest.raises(NotEnoughMemoryError, match="mixed levels"):
        nanogs.compare_mixed(scene, stream, max_memory="1MB")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda leaf: leaf.pop("bound"), "bound must be a JSON object"),
        (lambda leaf: leaf["bound"].update(min=[1, 2]), r"bound\.min must be a list of 3"),
        (lambda leaf: leaf["lods"].update({"00": {"file": 0, "offset": 0, "count": 0}}), "twice"),
    ],
)
def test_regions_that_are_damaged_are_refused(stream, tmp_path, change, words):
    described = json.loads(stream.read_text())
    leaf = described["tree"]
    while "children" in leaf:
        leaf = leaf["children"][0]
    change(leaf)
    (tmp_path / "lod-meta.json").write_text(json.dumps(described))
    with pytest.raises(FormatError, match=words):
        read_chunks(tmp_path / "lod-meta.json")
