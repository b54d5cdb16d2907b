"""Corrections of the errors that a cut is guided by, from renders of the best cut so far.

Each block is rendered with the same surroundings as when it is measured; see `trials`.
"""

import numpy as np

from nanogs.fit.targets import errors_of_splats
from nanogs.method.correct import GroupErrors, correct_errors
from nanogs.pipeline.scene import Scene, Task
from nanogs.pipeline.tasks.trials import best_cut, groups_of, grown
from nanogs.raster.rendering import concatenated, prepare
from nanogs.store.tables import Record


def correct(step: int, scene: Scene, task: Task) -> Record:
    """Correct the predicted errors of a block's merges by those that its groups show in views.

    A correction starts from the errors of the one before, the first one from those of the last
    balance, 1.
    """
    balances, block = len(scene.balances), scene.open(task.number)
    number = best_cut(scene, task.level, step)
    labels = scene.cut(task.number, task.level, number)
    groups = groups_of(scene, block, labels)
    drawn = concatenated(prepare(grown(scene, groups)), scene.surroundings(task.number))
    drawn, sums = drawn.with_buffers(), np.zeros((len(drawn), 2))
    views = len(scene.views.kept) + scene.settings.parameters.pictured  # about as many are compared
    for done, target in enumerate(scene.compared(task.number, block)):
        scene.on_progress(done, views)
        sums += errors_of_splats(drawn, target)
    by_label = np.empty((len(groups.labels), 2))
    by_label[groups.labels] = sums[: len(groups.labels)]
    ordering = scene.ordering(block, task.number, task.level, balances + step - 1)
    correction = correct_errors(ordering, labels, GroupErrors(*by_label.T.copy()))
    return scene.keep_correction(task, balances + step, correction)
