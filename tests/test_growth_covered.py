"""Growth of merged splats that are covered by others on all sides."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import nanogs
import reference_kernels as reference
from builders import same_pixel
from nanogs.kernels.side_coverage import AWAY, ENOUGH, THICK
from nanogs.method.cut import cut
from nanogs.method.forest import grow_forest
from nanogs.method.growth import MOST_GROWTH, Cover, covered_around
from nanogs.method.nodes import Nodes, activate_nodes
from nanogs.method.parameters import ForestParameters
from nanogs.method.store import Groups, cover_of, store_groups
from nanogs.neighbours import nearest_neighbours
from nanogs.progress import ignore_progress
from nanogs.raster.rendering import prepare, render
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras


def nodes_of(means, scales, turns):
    """Return nodes, scales and wxyz quaternions of splats with rotations (G, 3, 3)."""
    covariances = np.array([reference.pack(t @ np.diag(s**2) @ t.T)
                            for s, t in zip(scales, turns, strict=True)])  # fmt: skip
    ones, rows = np.ones(len(means)), np.arange(len(means), dtype=np.int32)
    nodes = Nodes(ones, ones, means, covariances, np.zeros((len(means), 3), np.float32), rows)
    quats = Rotation.from_matrix(turns).as_quat()[:, [3, 0, 1, 2]]
    return nodes, scales.astype(np.float32), quats.astype(np.float32)


def cover(nodes, alphas=1.0):
    return Cover(nodes.means, nodes.covariances, np.broadcast_to(alphas, len(nodes)).copy())


def reference_coverage(means, scales, turns, alphas, k):
    """Compute the coverage (G,) as the kernel does, with NumPy's solver."""
    neighbours = nearest_neighbours(means, k)
    shares = []
    for index in range(len(means)):
        by_length = np.argsort(scales[index])
        thick = (THICK * scales[index][by_length[1]]) ** 2
        sums = []
        for axis in by_length[1:]:
            for side in (-1, 1):
                point = means[index] + side * AWAY * scales[index][axis] * turns[index][:, axis]
                total = 0.0
                for other in neighbours[index]:
                    matrix = turns[other] @ np.diag(scales[other] ** 2) @ turns[other].T
                    d = point - means[other]
                    squared = d @ np.linalg.solve(matrix + thick * np.eye(3), d)
                    total += alphas[other] * np.exp(-0.5 * squared)
                sums.append(total)
        shares.append(min(1.0, min(sums) / ENOUGH))
    return np.array(shares)


@pytest.mark.parametrize("seed", range(4))
def test_coverage_of_the_sides_matches_the_reference(seed):
    rng = np.random.default_rng(seed)
    count = 60
    means = rng.normal(size=(count, 3)) * [1, 1, 0.1]
    scales = rng.uniform(0.05, 0.4, (count, 3))
    turns = Rotation.random(count, random_state=seed).as_matrix()
    alphas = rng.uniform(0.1, 1, count)
    nodes, stored, quats = nodes_of(means, scales, turns)
    some = np.arange(0, count, 2, dtype=np.int32)
    found = covered_around(cover(nodes, alphas), some, stored[some], quats[some])
    expected = reference_coverage(means, scales, turns, alphas, 16)[some]
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert 0 < expected.mean() < 1


def test_splats_in_the_middle_are_covered_and_those_at_the_edge_are_not():
    coordinates = np.arange(-4.0, 5.0)
    x, y = (axis.ravel() for axis in np.meshgrid(coordinates, coordinates))
    means = np.stack([x, y, 0 * x], axis=1)
    scales = np.tile([0.29, 0.28, 0.01], (len(means), 1))  # about the deviations of a unit square
    nodes, stored, quats = nodes_of(means, scales, np.tile(np.eye(3), (len(means), 1, 1)))
    rows = np.arange(len(means), dtype=np.int32)
    found = covered_around(cover(nodes), rows, stored, quats)
    edge = np.maximum(np.abs(x), np.abs(y)) == 4
    assert (found[edge] < 1e-3).all()
    assert (found[~edge] == 1).all()
    faint = covered_around(cover(nodes, 0.1), rows, stored, quats)
    assert (faint[~edge] < 0.5).all()


def test_a_single_group_is_not_covered():
    nodes, stored, quats = nodes_of(np.zeros((1, 3)), np.ones((1, 3)), np.eye(3)[None])
    one = np.zeros(1, np.int32)
    assert covered_around(cover(nodes), one, stored, quats).tolist() == [0.0]


def shell(count):
    """Opaque splats of many sizes on a sphere, too rough to be a sheet."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    size = 6 / np.sqrt(count) * rng.uniform(0.5, 1.5, (count, 2))
    axes = np.cross(np.tile([0, 0, 1.0], (count, 1)), normals)
    angles = np.arccos(np.clip(normals[:, 2], -1, 1)) / np.maximum(
        np.linalg.norm(axes, axis=1), 1e-9
    )
    quats = Rotation.from_rotvec(axes * angles[:, None]).as_quat()[:, [3, 0, 1, 2]]
    means = normals * rng.normal(1, 0.02, (count, 1))
    return Splats(
        means=means.astype(np.float32),
        log_scales=np.log(np.column_stack([size, 0.1 * size[:, :1]])).astype(np.float32),
        quats=quats.astype(np.float32),
        opacity_logits=np.full(count, 3, np.float32),
        sh=np.tile(np.float32([0.8, 0.2, -0.5]), (count, 1, 1)),
    )


def test_growth_of_covered_splats_keeps_a_rough_wall_opaque(monkeypatch):
    splats = shell(20_000)
    cameras = automatic_cameras(splats, 4, width=128, height=128)
    before = [render(prepare(splats), camera).alpha for camera in cameras]

    def lost_alpha():
        small = prepare(nanogs.simplify(splats, ratio=0.02, preset="fast")[0])
        after = [render(small, camera).alpha for camera in cameras]
        pairs = zip(before, after, strict=True)
        return np.mean([(a - b)[a > 0.98].mean() for a, b in pairs])

    with_growth = lost_alpha()
    monkeypatch.setattr(
        "nanogs.method.store.covered_around", lambda *given: np.zeros(len(given[1]))
    )
    assert with_growth < 0.5 * lost_alpha()


def test_the_growth_limit_rises_with_coverage():
    needed, covered = np.array([4.0, 4.0, 4.0, 1.1]), np.array([0.0, 0.5, 1.0, 1.0])
    model = shell(4)
    scales = np.exp(model.log_scales)
    groups = Groups(model, np.arange(4), np.ones(4, bool), scales, needed, np.ones(4), covered)

    def areas(growth):
        larger = np.exp(groups.grown(growth).log_scales)
        return (larger / scales).prod(axis=1)

    half = 1.25 + 0.5 * (MOST_GROWTH - 1.25)
    assert areas(1.25) == pytest.approx([1.25**2, half**2, MOST_GROWTH**2, 1.1], rel=1e-5)
    assert areas(3.0) == pytest.approx(needed, rel=1e-5)
    less, more = (groups.grown(growth).log_scales for growth in (1.25, 3.0))
    assert (less[:2].sum(axis=1) < more[:2].sum(axis=1)).all()
    assert np.array_equal(np.exp(model.log_scales), scales)


def test_all_that_must_grow_beyond_the_usual_limit_are_examined():
    splats, growth = shell(1000), 1.25
    leaves = activate_nodes(splats, np.arange(1000), np.zeros(3), same_pixel(0.01))
    forest = grow_forest(leaves, ForestParameters(), ignore_progress)
    labels = cut(forest, 80, 0.8)
    groups = store_groups(leaves, labels, splats, np.zeros(3), same_pixel(0.01), growth=growth)
    every = cover_of(leaves, labels, 80, same_pixel(0.01))
    rows, quats = groups.labels[groups.new].astype(np.int32), groups.model.quats[groups.new]
    covered = covered_around(every, rows, groups.scales, quats)
    wanting = groups.needed > growth**2
    assert (covered[wanting & (groups.needed < 2)] > 0).any()
    assert groups.covered == pytest.approx(np.where(wanting, covered, 0))


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """A rough wall, as a model and as a file."""
    path, splats = tmp_path_factory.mktemp("wall") / "wall.ply", shell(20_000)
    nanogs.save(splats, path)
    return splats, path


def in_blocks(path, **changes):
    """Simplify a file to a fiftieth in at least five blocks, and return the result."""
    out = path.with_name("small.ply")
    options = {"ratio": 0.02, "preset": "fast", "block": 4000, "overwrite": True} | changes
    report = nanogs.simplify_blocks(path, out, **options)
    assert report.blocks.blocks >= 5
    return nanogs.load(out)


def test_blocks_use_the_delivered_groups_of_neighbouring_blocks(wall, monkeypatch):
    calls = []

    def noted(cover, *given):
        calls.append(cover)
        return covered_around(cover, *given)

    monkeypatch.setattr("nanogs.method.store.covered_around", noted)
    small = in_blocks(wall[1], threads=1)
    delivered, alphas = small.means.astype(np.float64), 1 / (1 + np.exp(-small.opacity_logits))
    tree, every = cKDTree(delivered), np.concatenate([cover.means for cover in calls])
    shift = delivered[0] - every[np.argmin(np.linalg.norm(every - delivered[0], axis=1))]
    others = 0
    for cover in calls:
        assert cover.means.shape == (len(cover.alphas), 3)
        assert cover.covariances.shape == (len(cover.alphas), 6)
        distances, rows = tree.query(cover.means + shift)
        # A block does not have all splats that could move to its neighbours from a third block.
        same = distances < 1e-6
        assert same.mean() > 0.75
        assert distances.max() < 0.05  # groups are about 0.18 apart
        assert len(np.unique(rows[same])) == same.sum()
        assert cover.alphas[same] == pytest.approx(alphas[rows[same]], abs=1e-5)
        others += len(rows)
    assert others > 1.2 * len(small)


def test_walls_stay_nearly_as_opaque_in_blocks(wall, monkeypatch):
    splats, path = wall
    cameras = automatic_cameras(splats, 4, width=128, height=128)
    before = [render(prepare(splats), camera).alpha for camera in cameras]

    def lost_alpha(small):
        drawn = prepare(small)
        after = [render(drawn, camera).alpha for camera in cameras]
        return np.mean([(a - b)[a > 0.98].mean() for a, b in zip(before, after, strict=True)])

    whole = lost_alpha(nanogs.simplify(splats, ratio=0.02, preset="fast")[0])
    with_neighbours = lost_alpha(in_blocks(path))
    monkeypatch.setattr("nanogs.pipeline.work.near_groups", lambda *_given: [])
    without_neighbours = lost_alpha(in_blocks(path))
    assert with_neighbours < 1.1 * whole
    assert without_neighbours > 1.2 * whole
