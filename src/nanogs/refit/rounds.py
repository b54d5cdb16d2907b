"""Rounds of steps, each kept only if it brings the validation views nearer."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nanogs.progress import Parts
from nanogs.refit.descent import FITTED, Descent
from nanogs.refit.parameters import RefitParameters
from nanogs.refit.report import RefitStop, RoundReport
from nanogs.refit.state import State, activate, start, store
from nanogs.refit.targets import Target, squared_error
from nanogs.render.rasterize import prepare
from nanogs.splats import Splats

REJECTIONS = 2  # in turn, after which the rounds end
SHORTER = 0.5  # of the rate, after a rejection


@dataclass(frozen=True, slots=True)
class Outcome:
    """What `fit` came to; see `RefitReport` for the fields."""

    psnr_before: float
    psnr_after: float
    improved: bool
    rounds: tuple[RoundReport, ...]
    stop: RefitStop
    notes: tuple[str, ...]


def fit(
    small: Splats,
    fitting: Sequence[Target],
    deciding: Sequence[Target],
    parameters: RefitParameters,
    tell: Parts,
) -> tuple[Splats, Outcome]:
    """Fit the model in rounds.

    Args:
        small: The model.
        fitting: Views to fit to.
        deciding: Views that decide what is kept.
        parameters: See there.
        tell: Told of the steps made, and of how many there may be.

    Returns:
        The fitted model, or the input itself where nothing helped, and what happened.
    """
    before = _mean([squared_error(prepare(small), target) for target in deciding])
    descent = Descent(small, fitting, parameters)
    best, least, rate = start(small), before, parameters.rate
    reports: list[RoundReport] = []
    rejected, stop = 0, RefitStop.ROUNDS
    for number in range(parameters.rounds):
        begin = time.perf_counter()
        errors = _round(descent, rate, number, tell)
        model = activate(descent.state, small, descent.finite).model
        error = _mean([squared_error(model, target) for target in deciding])
        accepted = error < least
        seconds = time.perf_counter() - begin
        psnrs = _psnr(_mean(errors)), _psnr(least), _psnr(error)
        reports.append(RoundReport(FITTED, len(errors), rate, *psnrs, accepted, seconds))
        if accepted:
            best, least, rejected = descent.state.copy(), error, 0
            continue
        descent.begin(best)
        rejected, rate = rejected + 1, rate * SHORTER
        if rejected == REJECTIONS:
            stop = RefitStop.NO_PROGRESS
            break
    return _finish(small, best, deciding, before, tuple(reports), stop)


def _round(descent: Descent, rate: float, number: int, tell: Parts) -> list[float]:
    """The steps of one round; the schedule of their lengths spans all rounds."""
    steps = descent.parameters.steps
    total = steps * descent.parameters.rounds
    errors = []
    for i in range(number * steps, (number + 1) * steps):
        tell(i, total)
        errors.append(descent.step(rate, i / total))
    return errors


def _finish(
    small: Splats,
    best: State,
    deciding: Sequence[Target],
    before: float,
    reports: tuple[RoundReport, ...],
    stop: RefitStop,
) -> tuple[Splats, Outcome]:
    """The guard at the end measures the model that is handed out, rounded as it is stored."""
    result = store(best, small)
    after = _mean([squared_error(prepare(result), target) for target in deciding])
    improved = after < before
    notes = () if improved else ("nothing helped on the validation views: the model is unchanged",)
    if not improved:
        result, after = small, before
    return result, Outcome(_psnr(before), _psnr(after), improved, reports, stop, notes)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _psnr(error: float) -> float:
    return math.inf if error == 0 else -10 * math.log10(error)
