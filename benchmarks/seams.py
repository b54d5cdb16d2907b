"""Measure the error of models made in blocks, at their borders and elsewhere; random variation."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import nanogs
from nanogs.clock import StageClock
from nanogs.metrics import psnr, ssim
from nanogs.neighbours import nearest_neighbours
from nanogs.pipeline.in_blocks import plan_job
from nanogs.pipeline.job.result_writer import result_of
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.pipeline.run import InProcess, Run, run_tasks
from nanogs.pipeline.tasks.units import find_units
from nanogs.pipeline.work import Work
from nanogs.progress import Tracker
from nanogs.raster.rendering import prepare, render
from nanogs.splats import Splats
from nanogs.store.scratch import FolderScratch
from nanogs.views.automatic import automatic_cameras

VIEWS, SIZE = 8, 512


def in_blocks(path: Path, ratio: float, blocks: int, rounds: int) -> tuple[Splats, np.ndarray]:
    """Simplify in blocks; return the model, and the block (N,) of each splat of the original."""
    splats = nanogs.load(path)
    with tempfile.TemporaryDirectory() as name:
        source, folder = Path(name) / "in.ply", FolderScratch(Path(name) / "scratch")
        folder.prepare()
        nanogs.save(replace(splats, elements=()), source)
        size = int(len(splats) / blocks * 1.08) + 1
        request = Request(
            goal=Goal(ratio=ratio), inputs=(source,), output=Path("a.ply"), preset="fast",
            overrides={"rounds": rounds}, block=size,
        )  # fmt: skip
        settings, _ = plan_job(request)
        units = find_units(settings)
        run = Run(InProcess(), StageClock(), resumed=False)
        results = run_tasks(Work(folder, settings, 2), run, Tracker(None, []))
        codes = units.codes(splats)
        of_block = np.empty(len(splats), np.int64)
        parts = [results.work.partition.count(b) for b in range(results.work.partition.blocks)]
        of_block[np.argsort(codes, kind="stable")] = np.repeat(np.arange(len(parts)), parts)
        with result_of(results.work, 0) as result:
            return result.load(), of_block


def beside_borders(means: np.ndarray, of_block: np.ndarray, k: int) -> np.ndarray:
    """Return (N,) bool: splats with one of another block among their `k` neighbours."""
    near = nearest_neighbours(means.astype(np.float64), k)
    beside: np.ndarray = (of_block[near] != of_block[:, None]).any(axis=1)
    return beside


def compare(path: Path, ratio: float, blocks: int, rounds: int) -> dict[str, float]:
    """Compare results in memory and in blocks: quality, and error in the border band and elsewhere.

    The band consists of the splats that have one of another block among their nearest neighbours,
    as many as two groups have splats. Its weight in each pixel is rendered. Errors are given as the
    ratio of the mean squared error in the band to that elsewhere.
    """
    original = nanogs.load(path)
    original = original.take(original.finite())
    whole, _ = nanogs.simplify(original, ratio=ratio, preset="fast", rounds=rounds)
    divided, of_block = in_blocks(path, ratio, blocks, rounds)
    band = beside_borders(original.means, of_block, min(int(2 / ratio), 64))
    sh = np.zeros((len(original), 1, 3), np.float32)
    sh[:, 0] = np.where(band, 0.5, -0.5)[:, None] / 0.28209479
    marked = prepare(replace(original, sh=sh, extras={}))
    shown = prepare(original)
    models = {"whole": prepare(whole), "blocks": prepare(divided)}
    sums = {name: np.zeros(4) for name in models}
    scores: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    for camera in automatic_cameras(original, VIEWS, width=SIZE, height=SIZE):
        image, share = render(shown, camera).shown(), render(marked, camera).shown()[..., 0]
        for name, model in models.items():
            other = render(model, camera).shown()
            error = ((image - other) ** 2).mean(axis=2)
            covered = error > 0
            sums[name] += (
                (error * share).sum(), share.sum(),
                (error * (1 - share))[covered].sum(), (1 - share)[covered].sum(),
            )  # fmt: skip
            scores[name].append((psnr(image, other), ssim(image, other)))
    means = {name: np.mean(each, axis=0) for name, each in scores.items()}
    ratios = {name: (s[0] / s[1]) / (s[2] / s[3]) for name, s in sums.items()}
    return {
        "blocks": int(of_block.max()) + 1,
        "band": round(float(band.mean()), 4),
        "psnr": round(float(means["whole"][0]), 3),
        "psnr_change": round(float(means["blocks"][0] - means["whole"][0]), 3),
        "ssim_change": round(float(means["blocks"][1] - means["whole"][1]), 4),
        "band_over_rest_whole": round(float(ratios["whole"]), 3),
        "band_over_rest_blocks": round(float(ratios["blocks"]), 3),
    }


def chance(path: Path, ratio: float, rounds: int, times: int) -> list[float]:
    """Return changes of PSNR, in memory, when a random thousandth of the splats is left out."""
    original = nanogs.load(path)
    original = original.take(original.finite())
    shown = prepare(original)
    cameras = automatic_cameras(original, VIEWS, width=SIZE, height=SIZE)
    images = [render(shown, camera).shown() for camera in cameras]
    found = []
    for seed in range(times + 1):
        kept = np.random.default_rng(seed).permutation(len(original)) < 0.999 * len(original)
        splats = original.take(kept) if seed else original
        goal = round(ratio * len(original))
        small, _ = nanogs.simplify(splats, count=goal, preset="fast", rounds=rounds)
        model = prepare(small)
        views = zip(images, cameras, strict=True)
        found.append(
            np.mean(
                [psnr(image, render(model, view_camera).shown()) for image, view_camera in views]
            )
        )
    return [round(float(value - found[0]), 2) for value in found[1:]]
