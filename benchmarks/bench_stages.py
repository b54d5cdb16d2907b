"""Time each stage and kernel on one scene, with pytest-benchmark.

    python -m pytest benchmarks/bench_stages.py [--benchmark-json FILE]

The scene is synthetic, 100,000 splats of SH degree 3; NANOGS_BENCH_MODEL names another file. Each
stage is run once before it is timed. "MB" of a stage is the least amount of data that it must read
and write; divided by the seconds, it is a rate to compare with `copy`, which only copies memory.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nanogs
from nanogs import Splats, neighbours
from nanogs._types import F32
from nanogs.datasets.synthetic import make_scene
from nanogs.fit import targets
from nanogs.kernels.blocks import ALL_BLOCKS
from nanogs.kernels.forest import log_determinants, merge_increments
from nanogs.kernels.listing import list_tiles
from nanogs.kernels.raster import blend_tiles
from nanogs.method import cut, graph, match, nodes, order
from nanogs.method.activation import scene_origin
from nanogs.method.forest import grow_forest
from nanogs.method.paper import cost, gaussians, merge
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.method.reassign import reassign
from nanogs.method.store import store_groups
from nanogs.method.viewers import estimate_dilation
from nanogs.metrics import ssim
from nanogs.raster import rendering
from nanogs.views.automatic import automatic_cameras

RATIO = 10  # number of input splats per output splat

Timed = Callable[..., Any]
"""Times a call, and records the bytes of the arrays given after it."""
Scene = dict[str, Any]
"""Inputs of the stages, by name."""


def nothing(*_: object) -> None:
    """Ignore progress."""


@pytest.fixture(scope="module")
def splats() -> Splats:
    """Load or generate the model."""
    path = os.environ.get("NANOGS_BENCH_MODEL")
    return nanogs.load(path) if path else make_scene(100_000)


@pytest.fixture(scope="module")
def scene(splats: Splats) -> Scene:
    """Compute the inputs of all stages, each the output of an earlier one."""
    rows = np.flatnonzero(splats.finite())
    origin = scene_origin(splats.means[rows])
    alphas = splats.opacities()[rows]
    pixel = estimate_dilation(splats.means[rows] - origin, alphas, splats.render_mode, 720)
    rows = rows[order.morton_order(splats.means[rows] - origin)]
    leaves = nodes.activate_nodes(splats, rows, origin, pixel)
    pairs = graph.neighbour_pairs(leaves.means, 8)
    dets = np.empty(len(leaves))
    log_determinants(leaves.covariances, dets)
    costs = np.empty((len(pairs), 2), np.float32)
    merge_increments(
        np.ascontiguousarray(pairs), leaves.weights, leaves.means, leaves.covariances, dets,
        leaves.features, leaves.rows, leaves.second_rows, leaves.shares, costs,
    )  # fmt: skip
    forest = grow_forest(leaves, ForestParameters(), nothing)
    target = max(1, len(leaves) // RATIO)
    labels = cut.cut(forest, target, 0.8)
    merged = nodes.gather(leaves, labels, target)
    camera = automatic_cameras(splats, 1, width=512, height=512)[0]
    prepared = rendering.prepare(splats)
    return {
        "splats": splats, "rows": rows, "origin": origin, "pixel": pixel, "leaves": leaves,
        "pairs": pairs, "dets": dets, "costs": costs, "forest": forest, "target": target,
        "labels": labels, "merged": merged, "camera": camera, "prepared": prepared,
    }  # fmt: skip


@pytest.fixture
def timed(benchmark: Any) -> Timed:
    """Return a function that times a call and records the bytes that it must move."""

    def run(work: Callable[[], Any], *arrays: Any) -> Any:
        result = benchmark.pedantic(work, rounds=7, iterations=1, warmup_rounds=1)
        total = sum(array.nbytes for array in arrays)
        median = benchmark.stats.stats.median if benchmark.stats else 0
        benchmark.extra_info["MB"] = round(total / 1e6, 1)
        benchmark.extra_info["GB/s"] = round(total / 1e9 / median, 2) if median else None
        return result

    return run


def columns(splats: Splats) -> tuple[F32, ...]:
    """Return the model's float32 columns."""
    return splats.means, splats.log_scales, splats.quats, splats.opacity_logits, splats.sh


def test_copy(timed: Timed, splats: Splats) -> None:
    source = np.concatenate([column.reshape(-1) for column in columns(splats)])
    target = np.empty_like(source)
    timed(lambda: np.copyto(target, source), source, target)


def test_write_ply(timed: Timed, splats: Splats, tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    timed(lambda: nanogs.save(splats, path, overwrite=True), *columns(splats))


def test_read_ply(timed: Timed, splats: Splats, tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    nanogs.save(splats, path)
    timed(lambda: nanogs.load(path), *columns(splats))


def test_morton_order(timed: Timed, scene: Scene) -> None:
    means = scene["splats"].means.astype(np.float64)
    timed(lambda: order.morton_order(means), means)


def test_activate(timed: Timed, scene: Scene) -> None:
    moved = (*columns(scene["splats"])[:-1], scene["leaves"].covariances)
    timed(
        lambda: nodes.activate_nodes(
            scene["splats"], scene["rows"], scene["origin"], scene["pixel"]
        ),
        *moved,
    )


@pytest.mark.parametrize("k", [8, 16])
def test_neighbours(timed: Timed, scene: Scene, k: int) -> None:
    means = scene["leaves"].means
    found = neighbours.nearest_neighbours(means, k)
    timed(lambda: neighbours.nearest_neighbours(means, k), means, found)


def test_pairs(timed: Timed, scene: Scene) -> None:
    timed(lambda: graph.neighbour_pairs(scene["leaves"].means, 8), scene["pairs"])


def test_increments(timed: Timed, scene: Scene) -> None:
    leaves, out = scene["leaves"], np.empty_like(scene["costs"])
    pairs = np.ascontiguousarray(scene["pairs"])
    timed(
        lambda: merge_increments(
            pairs,
            leaves.weights,
            leaves.means,
            leaves.covariances,
            scene["dets"],
            leaves.features,
            leaves.rows,
            leaves.second_rows,
            leaves.shares,
            out,
        ),
        pairs, leaves.means, leaves.covariances, leaves.features, out,
    )  # fmt: skip


def test_match(timed: Timed, scene: Scene) -> None:
    costs = np.ascontiguousarray(scene["costs"].sum(axis=1))
    n = len(scene["leaves"])
    timed(lambda: match.match(scene["pairs"], costs, n, n // 2), scene["pairs"], costs)


def test_gather(timed: Timed, scene: Scene) -> None:
    leaves = scene["leaves"]
    timed(
        lambda: nodes.gather(leaves, scene["labels"], scene["target"]),
        leaves.means, leaves.covariances, leaves.features, scene["labels"],
    )  # fmt: skip


def test_grow_forest(timed: Timed, scene: Scene) -> None:
    timed(lambda: grow_forest(scene["leaves"], ForestParameters(), nothing), scene["pairs"])


def test_cut(timed: Timed, scene: Scene) -> None:
    forest = scene["forest"]
    moved = (forest.children, forest.levels, forest.increments, scene["labels"])
    timed(lambda: cut.cut(forest, scene["target"], 0.8), *moved)


def test_reassign(timed: Timed, scene: Scene) -> None:
    leaves = scene["leaves"]
    blurs = scene["pixel"].blurs(leaves.means)
    timed(
        lambda: reassign(leaves, scene["labels"], scene["target"], 1, blurs),
        leaves.means, leaves.covariances, leaves.features,
    )  # fmt: skip


def test_store(timed: Timed, scene: Scene) -> None:
    timed(
        lambda: store_groups(
            scene["leaves"],
            scene["labels"],
            scene["splats"],
            scene["origin"],
            scene["pixel"],
            growth=1.25,
        ).grown(1.1),
        scene["merged"].features,
    )


def test_published_costs(timed: Timed, scene: Scene) -> None:
    active = gaussians.activate(scene["splats"], scene["rows"], scene["origin"])
    masses = cost.log_masses(active)
    parameters = PaperParameters()
    timed(lambda: cost.pair_costs(active, scene["pairs"], masses, parameters), scene["pairs"])


def test_published_merge(timed: Timed, scene: Scene) -> None:
    active = gaussians.activate(scene["splats"], scene["rows"], scene["origin"])
    masses = cost.log_masses(active)
    costs = cost.pair_costs(active, scene["pairs"], masses, PaperParameters())
    plan = match.match(scene["pairs"], costs, len(active), len(active) // 2)
    timed(lambda: merge.merge(active, plan, masses), active.means, active.features)


def test_project(timed: Timed, scene: Scene) -> None:
    view = rendering.project(scene["prepared"], scene["camera"])
    moved = (scene["prepared"].factors, scene["prepared"].sh, view.geometry, view.features)
    timed(lambda: rendering.project(scene["prepared"], scene["camera"]), *moved)


def test_list_tiles(timed: Timed, scene: Scene) -> None:
    view = rendering.project(scene["prepared"], scene["camera"])
    timed(lambda: list_tiles(view.geometry, view.boxes, view.order, 512, 512), view.entries)


def test_blend(timed: Timed, scene: Scene) -> None:
    view = rendering.project(scene["prepared"], scene["camera"])
    image, left = np.empty((512, 512, 3), np.float32), np.empty((512, 512), np.float32)
    behind, probes = np.zeros(4, np.float32), np.empty((0, 512, 512), np.float32)
    partial = np.empty((len(view.entries), 0), np.float32)
    timed(
        lambda: blend_tiles(
            view.geometry, view.features, view.starts, view.entries, ALL_BLOCKS, behind, image,
            left, probes, partial,
        ),
        view.entries, image,
    )  # fmt: skip


def test_render_with_contributions(timed: Timed, scene: Scene) -> None:
    timed(
        lambda: rendering.render(scene["prepared"], scene["camera"], contributions=True),
        scene["prepared"].sh,
    )


def test_compute_gradients(timed: Timed, scene: Scene) -> None:
    target = targets.make_target(scene["prepared"], scene["camera"])
    small, _ = nanogs.simplify(scene["splats"], ratio=1 / RATIO, preset="fast")
    prepared = rendering.prepare(small)
    timed(lambda: targets.compute_gradients(prepared, target), prepared.sh)


def test_ssim(timed: Timed) -> None:
    images = np.random.default_rng(0).random((2, 512, 512, 3))
    timed(lambda: ssim(images[0], images[1]), images)
