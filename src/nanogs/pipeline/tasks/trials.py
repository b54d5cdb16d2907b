"""Comparison of candidates with the original on the deciding views; the best one is chosen.

Cuts of several balances are tried, the best one with its splats reassigned, and the best of these
with more growth. One choice is made for the whole scene: errors are added up over the blocks. Each
block is measured by itself, with the same surroundings in both images.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nanogs.fit.targets import Target
from nanogs.method.choose import GROWTH_MARGIN, further_growths, quality
from nanogs.method.visibility import LUMA
from nanogs.metrics import ssim
from nanogs.pipeline.scene import Members, Scene, Task
from nanogs.raster.rendering import PreparedSplats, concatenated, prepare, render
from nanogs.report import CandidateReport
from nanogs.splats import Splats
from nanogs.store.tables import Record

MOST = 100.0  # dB, of a view without any error
Errors = list[tuple[float, float]]  # of each view, summed up: squared error a channel, 1 - SSIM


def try_balances(scene: Scene, task: Task) -> Record:
    """Measure a block's cuts of all balances, and write their errors."""
    block = scene.open(task.number)
    wanted, others = scene.pictures(task.number, block), scene.surroundings(task.number)
    growth = scene.settings.parameters.growth
    errors = []
    for balance in range(len(scene.balances)):
        labels = scene.cut(task.number, task.level, balance)
        groups = scene.stored(Members(block.splats, block.rows, block.visible, labels))
        errors.append(_errors(groups.grown(growth), wanted, others))
        scene.on_progress(len(errors), len(scene.balances))
    return scene.write(task.name, {}, {"errors": errors})


def pick_balance(scene: Scene, task: Task) -> Record:
    """Write the index of the best balance for the whole scene, the first of equal ones."""
    reports = _cuts(scene, task.level)
    best = max(range(len(reports)), key=lambda number: reports[number].quality)
    return scene.write(task.name, {}, {"balance": best})


def try_reassigned(scene: Scene, task: Task) -> Record:
    """Measure a block's groups after reassignment, and write their errors."""
    return _try(scene, task, scene.settings.parameters.growth, reassigned=True)


def try_growth(step: int, scene: Scene, task: Task) -> Record:
    """Measure the better groups of a block, with a further growth, and write their errors."""
    best = candidates(scene, task.level, step)[1]
    growth = further_growths(scene.settings.parameters.growth)[step]
    return _try(scene, task, growth, reassigned=best.reassigned)


def grows_on(scene: Scene, level: int, step: int) -> bool:
    """Whether a growth is worth trying: it exists, and each before it clearly helped."""
    if step >= len(further_growths(scene.settings.parameters.growth)):
        return False
    tried, best = candidates(scene, level, step)
    return step == 0 or (best is tried[-1] and len(tried) == _before(scene) + step)


def choose(scene: Scene, task: Task) -> Record:
    """Write the choice: whether reassignment is kept, and how much splats may grow."""
    best = candidates(scene, task.level)[1]
    return scene.write(task.name, {}, {"reassigned": best.reassigned, "growth": best.growth})


def candidates(
    scene: Scene, level: int, steps: int | None = None
) -> tuple[list[CandidateReport], CandidateReport]:
    """Return the scores of all candidates of a level that were tried, and the best of them.

    Reassignment is undone if it does not help, and growth if it does not clearly help.

    Args:
        scene: The scene.
        level: Of the result.
        steps: Number of growths that may have been tried by now; by default all.
    """
    tried = _cuts(scene, level)
    best = tried[scene.balance(level)]
    if scene.settings.parameters.rounds:
        tried.append(_report(scene, level, "judge", replace(best, reassigned=True)))
        best = tried[-1] if tried[-1].quality > best.quality else best
    for step, growth in enumerate(further_growths(best.growth)[:steps]):
        tried.append(_report(scene, level, growth_stage(step), replace(best, growth=growth)))
        if tried[-1].quality <= best.quality + GROWTH_MARGIN:
            break
        best = tried[-1]
    return tried, best


def reports_of(scene: Scene, level: int) -> tuple[CandidateReport, ...]:
    """Return the candidates of a level in the order tried, with the chosen one marked."""
    tried, best = candidates(scene, level)
    return tuple(replace(each, chosen=each is best) for each in tried)


def growth_stage(step: int) -> str:
    """Return the name of the stage that tries a growth."""
    return f"growth_{step + 1}"


def _before(scene: Scene) -> int:
    """Return the number of candidates that are tried before growths are."""
    return len(scene.balances) + (scene.settings.parameters.rounds > 0)


def _cuts(scene: Scene, level: int) -> list[CandidateReport]:
    growth = scene.settings.parameters.growth
    return [
        _report(
            scene, level, "trial", CandidateReport(balance, False, growth, 0.0, 0.0, 0.0, False), n
        )
        for n, balance in enumerate(scene.balances)
    ]


def _try(scene: Scene, task: Task, growth: float, *, reassigned: bool) -> Record:
    """Measure one candidate in a block, and write its errors."""
    members = scene.members(task.number, task.level, reassigned=reassigned)
    wanted, others = scene.pictures(task.number, members), scene.surroundings(task.number)
    model = scene.stored(members).grown(growth)
    del members
    return scene.write(task.name, {}, {"errors": [_errors(model, wanted, others)]})


def _errors(
    model: Splats, wanted: Sequence[Target | None], others: PreparedSplats | None
) -> Errors:
    """Measure the errors of a block's candidate on the deciding views."""
    prepared, errors = concatenated(prepare(model), others), []
    for target in wanted:
        if target is None:
            errors.append((0.0, 0.0))
            continue
        shown = target.image[..., :3] / np.float32(255)
        image = render(prepared, target.camera).shown()
        squares = float(np.square(shown - image).sum(dtype=np.float64)) / 3
        pixels = target.camera.width * target.camera.height
        errors.append((squares, pixels * (1 - ssim(shown @ LUMA, image @ LUMA))))
    return errors


def _report(
    scene: Scene, level: int, stage: str, candidate: CandidateReport, number: int = 0
) -> CandidateReport:
    """Score a candidate, from the errors that a stage has found in all blocks."""
    pixels = np.array([camera.width * camera.height for camera in scene.deciding])
    errors = [record.facts["errors"][number] for record in scene.of_blocks(stage, level)]
    sums = np.sum([np.array(each) for each in errors], axis=0)
    with np.errstate(divide="ignore"):
        psnrs = np.minimum(-10 * np.log10(sums[:, 0] / pixels), MOST)
    psnr, similar = float(psnrs.mean()), float(np.mean(1 - sums[:, 1] / pixels))
    return replace(candidate, psnr=psnr, ssim=similar, quality=quality(psnr, similar))
