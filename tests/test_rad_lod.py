"""`nanogs lod` to Spark's `.rad`: a tree whose leaves are the model, and what is refused."""

import heapq
import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
import radfiles
from builders import model_bytes, random_splats
from launch import run
from nanogs import io
from nanogs.errors import FormatError, OptionError, OutputError
from nanogs.formatting import bytes_text
from nanogs.io.rad.header import read_header
from nanogs.io.rad.levels import heights
from nanogs.lod import links
from nanogs.lod.tree import Layer, above, as_rows, build, layers_of, tree_units_of
from nanogs.lod.tree_file import LevelsTree
from nanogs.method.order import morton_order
from nanogs.metrics import psnr
from nanogs.raster.rendering import render
from nanogs.source import InMemory
from radfiles import chunk, rad, tree_columns, typical_columns
from spark_page import render_in_spark
from test_rad_spark import three_clusters
from views_and_scores import opening_camera

RATIOS = (1, 0.5, 0.25, 0.1)


def tree_of(path):
    """Return the number of children and the first child of each row, as stored in the file."""
    _, chunks = radfiles.parse_rad(path.read_bytes())
    found = {"child_count": [], "child_start": []}
    for header, payload in chunks:
        for entry in header["properties"]:
            if entry["property"] in found:
                data = payload[entry["offset"] : entry["offset"] + entry["bytes"]]
                kind = "<u2" if entry["encoding"] == "u16" else "<u4"
                found[entry["property"]].append(np.frombuffer(radfiles.inflated(data), kind))
    return (np.concatenate(each).astype(np.int64) for each in found.values())


@pytest.fixture(scope="module")
def model():
    return random_splats(3000, degree=1, seed=2)


@pytest.fixture(scope="module")
def tree_path(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tree")
    io.save(model, folder / "a.ply")
    levels = ",".join(map(str, RATIOS))
    result = run("lod", folder / "a.ply", folder / "a.rad", "--levels", levels, "--preset", "fast")
    assert result.returncode == 0, result.stderr
    return folder / "a.rad"


def test_transparent_leaves_do_not_change_the_size_of_the_root():
    """Four transparent leaves make one node of the next layer, beside nodes of opaque leaves."""
    splats = random_splats(1).take(np.zeros(24, np.int64))
    splats.means[:] = np.random.default_rng(3).normal(0, 1e-3, (24, 3))
    splats.opacity_logits[:] = 40
    splats.opacity_logits[20:] = -np.inf

    def root(count):
        leaves, groups = InMemory(splats.take(np.arange(count))), np.arange(count) // 4
        means = leaves.load().means.astype(np.float64)
        middle = np.array([means[groups == each].mean(axis=0) for each in range(count // 4)])
        layers = [Layer(means, groups), Layer(middle, np.zeros(count // 4, np.int64))]
        top = Layer(means.mean(axis=0)[None], np.empty(0, np.int64))
        return build(leaves, [*layers, top], tree_units_of(InMemory(splats))).layers[-1].load()

    assert np.allclose(root(24).log_scales, root(20).log_scales, atol=1e-3)


def sheet(count):
    """Return equal thin splats at random in a square."""
    splats = random_splats(1).take(np.zeros(count, np.int64))
    splats.means[:] = np.random.default_rng(0).normal(size=(count, 3)) * [1, 1, 0.02]
    splats.log_scales[:] = np.log([0.5, 0.5, 0.02])
    splats.quats[:] = 1, 0, 0, 0
    splats.opacity_logits[:] = -3
    return splats


def root_of(splats, together):
    """Return the root of a tree whose inner nodes have as many children each."""
    leaves, layers, means = InMemory(splats), [], splats.means.astype(np.float64)
    while len(means) > 1:
        layers.append(Layer(means, np.arange(len(means)) // together))
        means = means.reshape(-1, together, 3).mean(axis=1)
    top = Layer(means, np.empty(0, np.int64))
    return build(leaves, [*layers, top], tree_units_of(leaves)).layers[-1].load()


@pytest.mark.parametrize("together", [2, 8])
def test_the_root_is_the_same_however_many_layers_are_below_it(together):
    expected, found = root_of(sheet(64), 64), root_of(sheet(64), together)
    assert found.opacities() == pytest.approx(expected.opacities(), rel=1e-5)
    np.testing.assert_allclose(found.log_scales, expected.log_scales, atol=1e-5)


def rows_sorted(means):
    return means[np.lexsort(means.T)]


def test_the_leaves_are_the_whole_model(model, tree_path):
    leaves = io.load(tree_path)
    np.testing.assert_array_equal(rows_sorted(leaves.means), rows_sorted(model.means))
    info = json.loads(run("info", tree_path, "--json").stdout)
    assert info["levels"][:4] == [3000, 1500, 750, 300]
    assert info["levels"][-1] == 1
    assert info["splats"] == 3000


def test_rows_are_in_the_order_that_spark_requires(tree_path):
    """The root first, siblings contiguous and after their parent, each row with one parent."""
    counts, starts = tree_of(tree_path)
    inner = np.flatnonzero(counts)
    assert (starts[inner] > inner).all()
    named = np.concatenate([np.arange(starts[i], starts[i] + counts[i]) for i in inner])
    np.testing.assert_array_equal(np.sort(named), np.arange(1, len(counts)))
    assert np.all(np.diff(starts[inner]) > 0)
    assert not starts[counts == 0].any()
    head, _ = radfiles.parse_rad(tree_path.read_bytes())
    assert head["splatEncoding"]["lodOpacity"] is True


def test_each_level_can_be_read(model, tree_path):
    for level, ratio in enumerate(RATIOS):
        found = nanogs.load(tree_path, level=level)
        assert len(found) == ratio * 3000
    result = run("convert", tree_path, tree_path.with_name("c.ply"), "--level", "2")
    assert result.returncode == 0, result.stderr
    assert len(io.load(tree_path.with_name("c.ply"))) == 750
    last = len(io.open(tree_path).levels)
    with pytest.raises(OptionError, match=f"has levels 0 to {last - 1}"):
        nanogs.load(tree_path, level=last)
    io.save(model, tree_path.with_name("plain.rad"))
    with pytest.raises(OptionError, match="has one level, 0, and no level 1; leave `level`"):
        nanogs.load(tree_path.with_name("plain.rad"), level=1)


def test_coarser_levels_look_like_the_model(tmp_path):
    """Each node covers what its leaves cover, so a coarser level changes the picture little."""
    model = three_clusters(2000)
    nanogs.write_levels(model, tmp_path / "a.rad", RATIOS, layout="spark tree", preset="fast")
    camera = opening_camera(model)
    whole = render(model, camera).shown()
    scores = [psnr(render(nanogs.load(tmp_path / "a.rad", level=n), camera).shown(), whole)
              for n in range(4)]  # fmt: skip
    assert scores[0] > 40
    assert scores == sorted(scores, reverse=True)
    assert scores[1] > 25


def test_the_same_bytes_for_any_number_of_threads(model, tree_path):
    nanogs.write_levels(
        model, tree_path.with_name("b.rad"), RATIOS, layout="spark tree", preset="fast", threads=1,
        source="a.ply",
    )  # fmt: skip
    assert tree_path.read_bytes() == tree_path.with_name("b.rad").read_bytes()


def test_levels_can_be_measured(model, tmp_path):
    manifest, _ = nanogs.write_levels(
        model, tmp_path / "a.rad", (1, 0.2), layout="spark tree", preset="fast", measured=True
    )
    first, second = manifest.levels
    assert first.psnr > 40 > second.psnr > 15
    assert first.bytes + second.bytes <= (tmp_path / "a.rad").stat().st_size


def test_the_reported_size_is_that_of_the_file(model, tmp_path):
    """It includes the headers and the nodes above the coarsest level."""
    out = tmp_path / "a.rad"
    io.save(model, tmp_path / "a.ply")
    result = run("lod", tmp_path / "a.ply", out, "--levels", "0.1", "--preset", "fast")
    assert f"1 level in {out}, {bytes_text(out.stat().st_size)}, " in result.stderr


def test_trees_made_in_blocks_look_like_the_model(tmp_path):
    """The leaves are the model, and the next level looks like it, as if made in memory."""
    model = three_clusters(3000)
    io.save(model, tmp_path / "a.ply")
    nanogs.write_levels(
        tmp_path / "a.ply",
        tmp_path / "a.rad",
        RATIOS,
        layout="spark tree",
        preset="fast",
        block=900,
    )
    source = io.open(tmp_path / "a.rad")
    assert source.levels[0] == 3000
    np.testing.assert_array_equal(rows_sorted(source.load().means), rows_sorted(model.means))
    assert {path.name for path in tmp_path.iterdir()} == {"a.ply", "a.rad"}
    camera = opening_camera(model)
    whole = render(model, camera).shown()
    assert psnr(render(nanogs.load(tmp_path / "a.rad", level=1), camera).shown(), whole) > 25


def test_a_job_interrupted_while_writing_can_be_resumed(model, tmp_path, monkeypatch):
    io.save(model, tmp_path / "a.ply")
    options = {"layout": "spark tree", "preset": "fast", "block": 900}
    nanogs.write_levels(tmp_path / "a.ply", tmp_path / "a.rad", RATIOS, **options)
    options |= {"job": tmp_path / "job", "resume": True}

    def interrupt(*_args, **_options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("nanogs.lod.tree_file.write", interrupt)
        with pytest.raises(KeyboardInterrupt):
            nanogs.write_levels(tmp_path / "a.ply", tmp_path / "b.rad", RATIOS, **options)
    assert not (tmp_path / "b.rad").exists()
    nanogs.write_levels(tmp_path / "a.ply", tmp_path / "b.rad", RATIOS, **options)
    assert (tmp_path / "a.rad").read_bytes() == (tmp_path / "b.rad").read_bytes()


def test_nothing_is_overwritten_without_w(tree_path):
    before = tree_path.read_bytes()
    result = run(
        "lod", tree_path.with_name("a.ply"), tree_path, "--levels", "1,0.1", "--preset", "fast"
    )
    assert result.returncode == 2
    assert "-w" in result.stderr
    assert tree_path.read_bytes() == before
    assert {path.suffix for path in tree_path.parent.iterdir()} <= {".ply", ".rad"}


def test_w_replaces_the_file_and_an_unused_fit_is_noted(tmp_path):
    io.save(random_splats(200, degree=0), tmp_path / "a.ply")
    noted = []
    for chosen in (["--preset", "fast"], ["-w"]):
        result = run("lod", tmp_path / "a.ply", tmp_path / "a.rad", "--levels", "1,0.2", *chosen)
        assert result.returncode == 0, result.stderr
        noted.append(
            "of the fit of the preset 'default' is left in them; without it, --steps 0, the tree"
            in " ".join(result.stderr.split())
        )
    assert noted == [False, True]
    assert {path.name for path in tmp_path.iterdir()} == {"a.ply", "a.rad"}


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--chunk", "100"], "65,536"), (["--format", "sog"], "determines it; leave it out"),
     (["--plain"], "only in 3D Tiles")],
)  # fmt: skip
def test_options_of_other_layouts_are_refused(tree_path, options, message):
    result = run("lod", tree_path.with_name("a.ply"), tree_path.with_name("d.rad"), *options)
    assert result.returncode == 2
    assert message in result.stderr


def test_nodes_with_too_many_children_are_refused(monkeypatch, model):
    monkeypatch.setattr("nanogs.lod.tree.MOST_CHILDREN", 20)
    levels = [InMemory(model), InMemory(model.take(np.arange(3)))]
    with pytest.raises(OptionError, match="give more levels between"):
        layers_of(levels)


# ---- links


@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 9))
def test_every_coarser_splat_has_at_least_one_child(many, few, seed):
    fine, coarse = max(many, few), min(many, few)
    shapes = [
        links.shapes_of(InMemory(random_splats(n, seed=s)))
        for n, s in ((fine, seed), (coarse, seed + 1))
    ]
    parents = links.parents_of(*shapes)
    assert set(parents.tolist()) == set(range(coarse))


def first_children(counts):
    """The first child of each row, 0 for leaves: children are in the order of their parents."""
    return np.where(counts > 0, np.cumsum(counts) - counts + 1, 0)


@given(st.integers(2, 40), st.integers(0, 9))
def test_trees_of_any_size_have_the_model_as_leaves(count, seed):
    model = random_splats(count, seed=seed)
    levels = [InMemory(model.take(np.arange(n))) for n in (count, (count + 1) // 2)]
    layers = layers_of(levels)
    rows, tree = as_rows(levels[0], layers)
    assert rows.count == sum(len(layer.means) for layer in layers) == len(tree.counts)
    assert tree.counts.sum() == rows.count - 1
    leaves = rows.load().take(np.flatnonzero(tree.counts == 0))
    np.testing.assert_array_equal(rows_sorted(leaves.means), rows_sorted(model.means))
    means, starts = rows.load().means, first_children(tree.counts)
    for row in np.flatnonzero(tree.counts):  # each is within the bounds of its children
        below = means[starts[row] : starts[row] + tree.counts[row]]
        assert (means[row] >= below.min(axis=0) - 1e-5).all()
        assert (means[row] <= below.max(axis=0) + 1e-5).all()


def test_a_parent_can_spare_all_its_children_but_the_nearest():
    fine, coarse = np.zeros((6, 3)), np.zeros((3, 3))
    fine[:, 0], coarse[:, 0] = [0.5, -0.1, 2, 10.3, 10.2, 19], [0, 10, 20]
    assert links._spare(np.array([0, 0, 0, 1, 1, 2]), fine, coarse).tolist() == [0, 2, 3]


def test_parents_are_the_likeliest_by_place_size_and_colour():
    """Against the densities by their definition; all coarse splats are candidates."""
    rng = np.random.default_rng(0)
    fine, coarse = random_splats(600, degree=0, seed=1), random_splats(8, degree=0, seed=2)
    fine.sh[:] = coarse.sh[rng.integers(8, size=600)] + rng.normal(0, 0.4, fine.sh.shape)
    shapes = [links.shapes_of(InMemory(each)) for each in (fine, coarse)]
    symmetric = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
    spreads = [each.covariances[:, symmetric] for each in shapes]
    expected = []
    for mean, spread, colour in zip(shapes[0].means, spreads[0], shapes[0].colours, strict=True):
        blurred = spread + spreads[1]
        deltas = mean - shapes[1].means
        far = np.einsum("mi,mij,mj->m", deltas, np.linalg.inv(blurred), deltas)
        tints = ((colour - shapes[1].colours).astype(np.float64) ** 2).sum(axis=1)
        unlikely = far + np.linalg.slogdet(blurred)[1] + tints / 0.15**2
        expected.append(unlikely.argmin())
    assert len(set(expected)) == 8  # no childless one, which would be given a child
    assert links.parents_of(*shapes).tolist() == expected


@given(st.integers(1, 40), st.integers(0, 40), st.booleans())
def test_childless_parents_in_one_place_get_one_child_each(few, more, apart):
    """All parents are at one place, `apart` from all children, and the last has every child."""
    fine = np.random.default_rng(few).normal(size=(few + more, 3))
    coarse = np.full((few, 3), 50.0 if apart else 0.0)
    parents = np.full(few + more, few - 1)
    links._give_to_childless(parents, fine, coarse)
    assert set(parents.tolist()) == set(range(few))


def test_rows_do_not_depend_on_how_many_are_merged_at_a_time(monkeypatch, model):
    levels = [InMemory(each) for each, _ in nanogs.levels(model, RATIOS, preset="fast")]
    layers = layers_of(levels)
    expected, tree = as_rows(levels[0], layers)
    monkeypatch.setattr("nanogs.lod.tree._ROWS", 70)
    rows, again = as_rows(levels[0], layers)
    np.testing.assert_array_equal(again.counts, tree.counts)
    for start, stop in ((0, rows.count), (40, 700), (3000, 3001)):
        assert model_bytes(rows.read(start, stop)) == model_bytes(expected.read(start, stop))


def test_links_do_not_depend_on_how_many_rows_are_read_at_a_time(monkeypatch):
    levels = [InMemory(random_splats(count, degree=0, seed=count)) for count in (250, 30)]
    expected = links.parents_of(*map(links.shapes_of, levels))
    monkeypatch.setattr(links, "_ROWS", 60)
    monkeypatch.setattr(InMemory, "blocks", lambda level: pieces(level.load(), 70))
    assert links.parents_of(*map(links.shapes_of, levels)).tolist() == expected.tolist()


def pieces(splats, rows):
    return (splats.span(at, min(at + rows, len(splats))) for at in range(0, len(splats), rows))


def test_levels_of_equal_counts_are_linked_by_position():
    fine, turn = random_splats(50, degree=0), np.random.default_rng(0).permutation(50)
    layers = layers_of([InMemory(fine), InMemory(fine.take(turn))])
    assert turn[layers[0].parents].tolist() == list(range(50))


def test_nodes_above_the_coarsest_level_are_in_the_middle_of_their_children():
    means = random_splats(70).means.astype(np.float64)
    layers = above(means)
    assert [len(layer.means) for layer in layers] == [70, 18, 5, 2, 1]
    for below, layer in pairwise(layers):
        middle = [
            below.means[below.parents == each].mean(axis=0) for each in range(len(layer.means))
        ]
        np.testing.assert_allclose(layer.means, middle, atol=1e-12)


def test_siblings_are_sorted_by_position():
    splats = random_splats(60, degree=0)
    layers = layers_of([InMemory(splats), InMemory(splats.take(np.arange(1)))])
    order = build(InMemory(splats), layers, tree_units_of(InMemory(splats))).order
    assert order.tolist() == morton_order(splats.means.astype(np.float64)).tolist()


def test_units_are_those_of_the_whole_model(monkeypatch):
    splats = random_splats(600, degree=0)
    splats.means[300:] += 10
    expected = tree_units_of(InMemory(splats)).origin
    monkeypatch.setattr("nanogs.lod.tree._SAMPLE", 100)
    np.testing.assert_allclose(tree_units_of(InMemory(splats)).origin, expected, atol=1)


def test_an_existing_file_is_refused_before_the_work(tmp_path):
    (tmp_path / "a.rad").write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists"):
        LevelsTree(tmp_path / "a.rad", overwrite=False, source="a.ply").check()


def test_splats_get_the_parent_of_their_own_cluster():
    """Two clusters that nearly touch, one of them flat and wide, and a parent for each."""
    rng = np.random.default_rng(0)
    model = random_splats(200, degree=0)
    low = np.arange(200) < 100
    means = rng.normal(size=(200, 3)) * np.where(low[:, None], (2, 2, 0.02), 0.3)
    means[~low] += (0, 0, 1)
    model.means[:] = means
    model.log_scales[:] = -3
    pair = model.take(np.array([0, 199]))
    pair.means[:] = (0, 0, 0), (0, 0, 1)
    pair.log_scales[:] = np.log([(2, 2, 0.03), (0.3, 0.3, 0.3)])
    pair.quats[:] = (1, 0, 0, 0)
    parents = links.parents_of(*(links.shapes_of(InMemory(each)) for each in (model, pair)))
    assert ((parents == 1) == ~low).mean() > 0.97


# ---- damaged trees


def tree_file(counts, starts):
    count = len(counts)
    columns = [*typical_columns(count)[0], *tree_columns(counts, starts)]
    return rad([chunk(columns, count)], count, lodTree=True)


@pytest.mark.parametrize(
    ("counts", "starts", "message"),
    [
        ([2, 0, 0, 0], [1, 0, 0, 0], "several parents, or none"),
        ([2, 2, 0, 0], [1, 2, 0, 0], "several parents, or none"),
        ([1, 0, 1, 1], [1, 0, 3, 2], "comes before its parent"),
        ([1, 0, 2, 0], [3, 0, 1, 0], "comes before its parent"),
        ([0, 1, 2, 0], [0, 1, 2, 0], "comes before its parent"),
        ([3, 0, 0, 0], [2, 0, 0, 0], "several parents, or none"),
    ],
)
def test_damaged_trees_are_refused(tmp_path, counts, starts, message):
    (tmp_path / "a.rad").write_bytes(tree_file(counts, starts))
    with pytest.raises(FormatError, match=message):
        heights(read_header(tmp_path / "a.rad"))
    with pytest.raises(FormatError, match=message):
        nanogs.load(tmp_path / "a.rad", level=1)


def test_trees_of_too_many_levels_are_refused(tmp_path):
    n = 400
    data = tree_file([1] * (n - 1) + [0], [*range(1, n), 0])
    (tmp_path / "a.rad").write_bytes(data)
    with pytest.raises(FormatError, match="more than 256 levels"):
        nanogs.load(tmp_path / "a.rad", level=1)


def test_levels_of_a_lopsided_tree(tmp_path):
    """A leaf directly below the root is in all levels except that of the root."""
    parts, given_values, leaves = radfiles.small_tree()
    (tmp_path / "a.rad").write_bytes(rad(parts, 8, lodTree=True))
    assert io.open(tmp_path / "a.rad").levels == (5, 3, 1)
    for level, rows in enumerate((leaves, [1, 2, 3], [0])):
        found = nanogs.load(tmp_path / "a.rad", level=level)
        np.testing.assert_array_equal(found.means, given_values["center"][rows])


# ---- Spark


def frontier(rows, counts, starts, camera, most):
    """Return the rows that Spark draws: its traversal refines the largest row on screen first."""
    sizes = 2 * rows.scales().astype(np.float64).mean(axis=1)
    sizes /= np.linalg.norm(rows.means - camera.position, axis=1)
    heap, drawn, total = [(-sizes[0], 0)], [], 1
    while heap and -heap[0][0] > 1 / camera.fy:
        row = heap[0][1]
        if counts[row] == 0:
            drawn.append(heapq.heappop(heap)[1])
            continue
        if total - 1 + counts[row] > most:
            break
        heapq.heappop(heap)
        total += counts[row] - 1
        for child in range(starts[row], starts[row] + counts[row]):
            heapq.heappush(heap, (-sizes[child], child))
    return np.array(sorted(drawn + [row for _, row in heap]))


@pytest.mark.slow
@pytest.mark.usefixtures("one_tab")
@pytest.mark.filterwarnings("default")  # the driver's own warnings are not ours
@pytest.mark.parametrize("paged", [False, True])
def test_spark_draws_the_expected_rows_of_a_tree(tmp_path, paged):
    """All splats if the limit allows it, else the expected rows of several levels."""
    model = three_clusters(3000)
    camera = opening_camera(model, 160, 120)
    path, mesh = tmp_path / "a.rad", {"paged": paged}
    nanogs.write_levels(model, path, RATIOS, layout="spark tree", preset="fast")
    whole = render(model, camera).shown()
    shown, state = render_in_spark(path, camera, tmp_path, mesh=mesh, lodRenderScale=0)
    assert state["splats"] == 3000
    assert psnr(shown, whole) > 30
    levels = [InMemory(each) for each, _ in nanogs.levels(model, RATIOS, preset="fast")]
    rows, tree = as_rows(levels[0], layers_of(levels))
    chosen = frontier(rows.load(), tree.counts, first_children(tree.counts), camera, 900)
    expected = render(rows.load().take(chosen), camera).shown()
    few, state = render_in_spark(path, camera, tmp_path, mesh=mesh, lodSplatCount=900)
    assert abs(state["splats"] - len(chosen)) < 5  # Spark keeps sizes as half floats
    assert psnr(few, expected) > 30
    assert 22 < psnr(few, whole) < psnr(shown, whole)
    if paged:
        assert state["requests"].count("scene/a.rad") >= 2  # the header, and chunks by byte range
