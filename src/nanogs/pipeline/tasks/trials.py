"""Comparison of candidates with the original on the deciding views; the best one is chosen.

Cuts of several balances are tried, then cuts whose errors are corrected by those that the best one
shows, the best of all with its splats reassigned, and the best of these with more growth. One
choice is made for the whole scene: errors are added up over the blocks. Each block is measured by
itself, with the same surroundings in both images.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nanogs import parallel
from nanogs._types import F32, I32, U8
from nanogs.fit.targets import Target
from nanogs.method.choose import GROWTH_MARGIN, LUMA, further_growths, quality
from nanogs.method.store import Groups
from nanogs.metrics import ssim
from nanogs.pipeline.scene import SUMS, Block, Members, Scene, Task
from nanogs.raster.rendering import PreparedSplats, clipped, concatenated, prepare, render
from nanogs.report import CandidateReport
from nanogs.slices import slices
from nanogs.splats import Splats
from nanogs.store.tables import Record

MOST = 100.0  # dB, of a view without any error
_ROWS = 32  # of two images that are compared at a time, so that they stay in the cache
Errors = list[tuple[float, float]]  # of each view, summed up: squared error a channel, 1 - SSIM


def try_balances(scene: Scene, task: Task) -> Record:
    """Measure a block's cuts of all balances, and write their errors."""
    return _try_cuts(scene, task, range(len(scene.balances)))


def try_corrected(step: int, scene: Scene, task: Task) -> Record:
    """Measure a block's cut with corrected errors, and write its errors."""
    return _try_cuts(scene, task, [len(scene.balances) + step])


def correction_is_promising(scene: Scene, level: int, step: int) -> bool:
    """Whether a correction is worth trying: the first one, or if the one before was the best."""
    return step == 0 or best_cut(scene, level, step) == len(scene.balances) + step - 1


def has_corrected(scene: Scene, level: int, step: int) -> bool:
    """Whether a correction found errors to correct in any block; its stage must be done."""
    return any(any(record.facts[SUMS]) for record in scene.of_blocks(nth("correct", step), level))


def best_cut(scene: Scene, level: int, corrections: int | None = None) -> int:
    """Return the number of the best cut of the whole scene, the first of equal ones.

    Args:
        scene: The scene.
        level: Of the result.
        corrections: How many corrections may have been tried by now; by default all.
    """
    reports = _cuts(scene, level, corrections)
    return max(range(len(reports)), key=lambda number: reports[number].quality)


def pick_cut(scene: Scene, task: Task) -> Record:
    """Write the number of the best cut for the whole scene."""
    return scene.write(task.name, {}, {"cut": best_cut(scene, task.level)})


def groups_of(scene: Scene, block: Block, labels: I32) -> Groups:
    """Merge the groups of one of a block's cuts."""
    return scene.stored(Members(block.splats, block.rows, block.visible, labels))


def grown(scene: Scene, groups: Groups) -> Splats:
    """Return the splats of groups, grown as candidates are before more growth is tried."""
    return groups.grown(scene.settings.parameters.growth)


def try_reassigned(scene: Scene, task: Task) -> Record:
    """Measure a block's groups after reassignment, and write their errors."""
    return _try(scene, task, scene.settings.parameters.growth, reassigned=True)


def try_growth(step: int, scene: Scene, task: Task) -> Record:
    """Measure the better groups of a block, with a further growth, and write their errors."""
    best = candidates(scene, task.level, step)[1]
    growth = further_growths(scene.settings.parameters.growth)[step]
    return _try(scene, task, growth, reassigned=best.reassigned)


def growth_is_promising(scene: Scene, level: int, step: int) -> bool:
    """Whether a growth is worth trying: it exists, and each before it clearly helped."""
    if step >= len(further_growths(scene.settings.parameters.growth)):
        return False
    tried, best = candidates(scene, level, step)
    return step == 0 or best is tried[-1]


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
    best = tried[scene.picked(level)]
    if scene.settings.parameters.rounds:
        tried.append(_report(scene, level, "judge", replace(best, reassigned=True)))
        best = tried[-1] if tried[-1].quality > best.quality else best
    for step, growth in enumerate(further_growths(best.growth)[:steps]):
        tried.append(_report(scene, level, nth("growth", step), replace(best, growth=growth)))
        if tried[-1].quality <= best.quality + GROWTH_MARGIN:
            break
        best = tried[-1]
    return tried, best


def reports_of(scene: Scene, level: int) -> tuple[CandidateReport, ...]:
    """Return the candidates of a level in the order tried, with the chosen one marked."""
    tried, best = candidates(scene, level)
    return tuple(replace(each, chosen=each is best) for each in tried)


def nth(stage: str, step: int) -> str:
    """Return the name of a stage that is done again in each step: "growth_1" is that of step 0."""
    return f"{stage}_{step + 1}"


def _cuts(scene: Scene, level: int, corrections: int | None = None) -> list[CandidateReport]:
    """Return the scores of the cuts that were tried, those of all balances first.

    Args:
        scene: The scene.
        level: Of the result.
        corrections: How many corrections may have been tried by now; by default all.
    """
    growth = scene.settings.parameters.growth
    tried = [
        _report(scene, level, "trial", _unscored(balance, growth), n)
        for n, balance in enumerate(scene.balances)
    ]
    best = max(tried, key=lambda report: report.quality)
    most = scene.settings.parameters.corrections if corrections is None else corrections
    for step in range(most):
        if not has_corrected(scene, level, step):
            break
        report = replace(tried[-1], balance=scene.balances[-1], corrections=step + 1)
        tried.append(_report(scene, level, nth("trial", step), report))
        if tried[-1].quality <= best.quality:
            break
        best = tried[-1]
    return tried


def _unscored(balance: float, growth: float) -> CandidateReport:
    """Return a cut of a balance as a candidate that `_report` has yet to score."""
    return CandidateReport(
        balance=balance, corrections=0, reassigned=False, growth=growth,
        psnr=0.0, ssim=0.0, quality=0.0, chosen=False,
    )  # fmt: skip


def _try_cuts(scene: Scene, task: Task, numbers: Sequence[int]) -> Record:
    """Measure some of a block's cuts, and write their errors."""
    block = scene.open(task.number)
    others = scene.surroundings(task.number)
    wanted, errors = scene.deciding_targets(block, others), []
    for number in numbers:
        groups = groups_of(scene, block, scene.cut(task.number, task.level, number))
        errors.append(_errors(grown(scene, groups), wanted, others))
        scene.on_progress(len(errors), len(numbers))
    return scene.write(task.name, {}, {"errors": errors})


def _try(scene: Scene, task: Task, growth: float, *, reassigned: bool) -> Record:
    """Measure one candidate in a block, and write its errors."""
    members = scene.members(task.number, task.level, reassigned=reassigned)
    others = scene.surroundings(task.number)
    wanted = scene.deciding_targets(members, others)
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
        image = render(prepared, target.camera).color
        squares, alike = _compared(target.image, image)
        pixels = target.camera.width * target.camera.height
        errors.append((squares, pixels * (1 - alike)))
    return errors


def _compared(wanted: U8, image: F32) -> tuple[float, float]:
    """Compare an image of the original with a candidate's, on all threads.

    Args:
        wanted: (H, W, 4) uint8, the original.
        image: (H, W, 3) colours of the candidate, not clipped.

    Returns:
        The sum over the pixels of the mean squared difference of channels; the SSIM of grey values.
    """
    grey = np.empty((2, *image.shape[:2]))

    def compare(rows: slice) -> float:
        first = np.divide(wanted[rows, :, :3], 255, dtype=np.float32)
        second = clipped(image[rows])
        grey[0, rows], grey[1, rows] = first @ LUMA, second @ LUMA
        return float(np.square(first - second).sum(dtype=np.float64))

    squares = parallel.map_ordered(slices(len(image), _ROWS), compare)
    return sum(squares) / 3, ssim(*grey)


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
