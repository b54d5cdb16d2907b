"""Growth of merged splats on flat sheets, behind which there are no other splats."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import nanogs
import reference_kernels as reference
from nanogs.kernels.sheet_growth import DENSE, FLATNESS, sheet_growths
from nanogs.method.growth import MOST_GROWTH, area_needs, blocked, growth_on_sheets
from nanogs.method.nodes import Nodes, gather
from nanogs.metrics import psnr
from nanogs.raster.rendering import prepare, render
from nanogs.splats import Splats, concatenate
from nanogs.views.automatic import automatic_cameras


def plane(count, seed=0):
    """Opaque flat splats of one colour at random places of a square."""
    rng = np.random.default_rng(seed)
    size = 2 / np.sqrt(count)
    means = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0]
    return Splats(
        means=means.astype(np.float32),
        log_scales=np.log(np.tile([size, size, 0.05 * size], (count, 1))).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacity_logits=np.full(count, 2, np.float32),
        sh=np.tile(np.float32([0.8, 0.2, -0.5]), (count, 1, 1)),
    )


def nodes_at(points, covariance):
    count = len(points)
    covariances = np.tile(reference.pack(covariance), (count, 1))
    features = np.zeros((count, 3), np.float32)
    weights = np.random.default_rng(1).uniform(0.5, 2, count)
    rows = np.arange(count, dtype=np.int32)
    return Nodes(weights, weights, points, covariances, features, rows)


def reference_growth(nodes):
    """Return the growth of all nodes as one group, as `sheet_growths` does, with NumPy's `eigh`."""
    shares = nodes.weights / nodes.weights.sum()
    offsets = nodes.means - shares @ nodes.means
    between = (shares[:, None] * offsets).T @ offsets
    values, axes = np.linalg.eigh(between)
    whole = between + reference.unpack(nodes.covariances[0])
    projected = axes[:, 1:].T @ whole @ axes[:, 1:]
    layers = 2 * np.pi * np.sqrt(np.linalg.det(projected)) / (12 * np.sqrt(values[1] * values[2]))
    return np.exp(-(values[0] / values[1]) / FLATNESS**2) * np.sqrt(DENSE / layers)


def growths(nodes):
    labels = np.zeros(len(nodes), np.int32)
    return growth_on_sheets(gather(nodes, labels, 1), nodes, labels)


@pytest.mark.parametrize("thickness", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("size", [1.5, 2.5])
def test_growth_equals_the_reference(thickness, size):
    rng = np.random.default_rng(2)
    turn = Rotation.random(random_state=3).as_matrix()
    points = rng.normal(size=(30, 3)) * [1.5, 1, thickness] @ turn.T
    nodes = nodes_at(points, turn @ np.diag([size**2, size**2, 1e-4]) @ turn.T)
    merged, found = gather(nodes, np.zeros(30, np.int32), 1), np.empty(1)
    sheet_growths(
        np.array([0, 30]), np.arange(30, dtype=np.int32), nodes.weights, nodes.means,
        merged.weights, merged.means, merged.covariances, found,
    )  # fmt: skip
    assert reference_growth(nodes) < MOST_GROWTH
    assert found == pytest.approx(reference_growth(nodes), rel=1e-9)
    assert growths(nodes) == max(found[0], 1)


def test_only_groups_on_sheets_grow():
    rng = np.random.default_rng(4)
    small = 1e-4 * np.eye(3)
    sheet = rng.normal(size=(20, 3)) * [1, 1, 0]
    line, cloud = sheet * [1, 0.01, 0], rng.normal(size=(20, 3))
    assert growths(nodes_at(sheet, small)) == MOST_GROWTH
    for points in (line, cloud, sheet[:3], np.zeros((20, 3))):
        assert growths(nodes_at(points, small)) == 1


@pytest.mark.parametrize(
    ("coverage_ratio", "area_ratio"), [(0.5, 1), (2, 2), (3.2, 3.2), (3.3, 1.8**2), (10, 1.8**2)]
)
def test_sheets_grow_up_to_their_members_coverage_within_a_limit(coverage_ratio, area_ratio):
    sheet = np.random.default_rng(4).normal(size=(20, 3)) * [1, 1, 0]
    nodes, labels = nodes_at(sheet, 1e-4 * np.eye(3)), np.zeros(20, np.int32)
    merged, areas = gather(nodes, labels, 1), np.array([nodes.coverages.sum() / coverage_ratio])
    for sheets, least in ((True, area_ratio), (False, 1)):
        needs, found = area_needs(merged, nodes, labels, areas, sheets=sheets)
        assert found == pytest.approx(least)
        assert needs == pytest.approx(blocked(merged.coverages, areas, np.array([np.inf])) / areas)


@pytest.mark.parametrize(("ratio", "min_psnr"), [(0.1, 28.0), (0.01, 20.0)])
def test_a_plane_of_one_colour_has_no_holes(ratio, min_psnr):
    splats = plane(6000)
    cameras = automatic_cameras(splats, 4, width=128, height=128)
    original = [render(prepare(splats), camera).shown() for camera in cameras]

    def score(preset):
        small = prepare(nanogs.simplify(splats, ratio=ratio, preset=preset)[0])
        shown = [render(small, camera).shown() for camera in cameras]
        return np.mean([psnr(a, b) for a, b in zip(original, shown, strict=True)])

    assert score("fast") > max(score("paper") + 1, min_psnr)


def test_splats_of_alpha_zero_leave_no_holes():
    """For example splats whose alpha was rounded to 0 by a format with 8 bits."""
    alive = plane(3000)
    dead = replace(alive.take(np.arange(1000)), opacity_logits=np.full(1000, -np.inf, np.float32))
    cameras = automatic_cameras(alive, 4, width=128, height=128)

    def score(splats):
        small = nanogs.simplify(splats, count=300, preset="fast")[0]
        return np.mean(
            [psnr(render(alive, each).shown(), render(small, each).shown()) for each in cameras]
        )

    assert score(concatenate([alive, dead])) > score(alive) - 1
