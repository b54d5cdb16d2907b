"""Corrections of the errors that a cut is guided by, from renders of the best cut so far.

Each block is rendered with the same surroundings as when it is measured; see `trials`.
"""

from collections.abc import Callable, Iterable

import numpy as np

from nanogs._types import F64
from nanogs.fit.targets import Target, errors_of_splats
from nanogs.method.correct import GroupErrors, correct_errors
from nanogs.pipeline.scene import Scene, Task
from nanogs.pipeline.tasks.trials import best_cut, groups_of, grown
from nanogs.raster.rendering import PreparedSplats, concatenated, prepare
from nanogs.store.tables import Record

ARTEFACTS = 1.5  # see `summed_errors`


def correct(step: int, scene: Scene, task: Task) -> Record:
    """Correct the predicted errors of a block's merges by those that its groups show in views.

    A correction starts from the errors of the one before, the first one from those of the last
    balance, 1.
    """
    balances, block = len(scene.balances), scene.open(task.number)
    number = best_cut(scene, task.level, step)
    labels = scene.cut(task.number, task.level, number)
    groups = groups_of(scene, block, labels)
    others = scene.surroundings(task.number)
    drawn = concatenated(prepare(grown(scene, groups)), others)
    views = len(scene.views.kept) + scene.settings.parameters.pictured  # about as many are compared
    targets = scene.correction_targets(task.number, block, others)
    sums = summed_errors(drawn.with_buffers(), targets, lambda done: scene.on_progress(done, views))
    by_label = np.empty((len(groups.labels), 2))
    by_label[groups.labels] = sums[: len(groups.labels)]
    ordering = scene.ordering(block, task.number, task.level, balances + step - 1)
    correction = correct_errors(ordering, labels, GroupErrors(*by_label.T.copy()))
    return scene.keep_correction(task, balances + step, correction)


def summed_errors(
    drawn: PreparedSplats, targets: Iterable[Target], on_view: Callable[[int], None]
) -> F64:
    """Sum `errors_of_splats` over views, at half of their size where that tells as much.

    Half takes a third of the time. But splats of about a pixel or less look larger there than in
    the reduced picture of the original, an error that has nothing to do with merging. So half is
    used only if its mean error in the first view is at most `ARTEFACTS` times that at full size.

    Args:
        drawn: N splats.
        targets: The views of the original.
        on_view: Is called with the number of views that are done.

    Returns:
        (N, 2) float64, the sums.
    """
    sums, halved = np.zeros((len(drawn), 2)), None
    for done, target in enumerate(targets):
        on_view(done)
        if halved is None:
            full, half = (errors_of_splats(drawn, target, halved=each) for each in (False, True))
            halved = _mean(half) <= ARTEFACTS * _mean(full)
            sums += half if halved else full
        else:
            sums += errors_of_splats(drawn, target, halved=halved)
    return sums


def _mean(sums: F64) -> float:
    """Return the mean squared error of `errors_of_splats`."""
    squared, light = sums.sum(axis=0)
    return float(squared / light) if light else 0.0
