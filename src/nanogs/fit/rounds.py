"""Rounds of steps; of each round, the part is kept that improves the validation views."""

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nanogs.fit.descent import FITTED, Descent
from nanogs.fit.groups import ViewGroup, pixels_text
from nanogs.fit.on_card import descent_for
from nanogs.fit.parameters import RefitParameters
from nanogs.fit.report import GroupReport, RefitStop, RoundReport
from nanogs.fit.state import State, range_notes, start, store
from nanogs.fit.targets import Fitting
from nanogs.io.rate_distortion import Curvatures
from nanogs.progress import PartProgress
from nanogs.raster.rendering import PreparedSplats, concatenated, prepare
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.fit.shared import SharedHarmonics

# Backtracking line search: shares of the way from the best state to the end of a round; the first
# that improves the validation views is kept.
SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)
AVERAGED = 0.2  # share of all steps, the last ones, whose states are averaged; one round at most
SHORTER = 0.7  # factor of the learning rate after a round of which only a part was kept
SHORTEST = 0.25  # the same after a round of which nothing was kept
# The fit ends after a round of which nothing was kept if the next learning rate would be below this
# share of the first.
LEAST = 0.05


class FitOutcome(NamedTuple):
    """The fields of `RefitReport` that a fit determines."""

    groups: tuple[GroupReport, ...]
    psnr_before: float
    psnr_after: float
    improved: bool
    rounds: tuple[RoundReport, ...]
    stop: RefitStop
    notes: tuple[str, ...]


class Fitted(NamedTuple):
    """The result of a fit: the model, how much its values show, and what is reported."""

    splats: Splats
    curvatures: Curvatures
    outcome: FitOutcome


class Validator:
    """Accepts or rejects states by their PSNR on the validation views.

    States are compared as the models that would be delivered, values as stored. A state is better
    if the mean PSNR over the groups is higher and no group is below the input.

    Args:
        small: The input.
        groups: The validation views.
        surroundings: Splats that are drawn together with every model, if any.
        shared: Which splats share their higher harmonics, if any do.

    Attributes:
        before: PSNR of the input on each group, dB.
        best: The same of the best state so far.
    """

    def __init__(
        self,
        small: Splats,
        groups: Sequence[ViewGroup],
        surroundings: PreparedSplats | None = None,
        shared: "SharedHarmonics | None" = None,
    ) -> None:
        self.small = small
        self.surroundings = surroundings
        self.shared = shared
        self.groups = groups
        self.before = self._psnrs(small)
        self.best = self.before

    def accepts(self, state: State) -> bool:
        """Return whether the state is better than the best so far; if so, remember its PSNRs."""
        psnrs = self._psnrs(self.delivered(state))
        better = _mean(psnrs) > _mean(self.best)
        if better and all(new >= old for new, old in zip(psnrs, self.before, strict=True)):
            self.best = psnrs
            return True
        return False

    def delivered(self, state: State) -> Splats:
        """Return the model of a state as it would be delivered."""
        fitted = store(state, self.small)
        return self.shared.spread(fitted, self.small) if self.shared else fitted

    def reports(self) -> tuple[GroupReport, ...]:
        """Report the PSNR of each group before and after."""
        return tuple(
            GroupReport(
                group.name,
                tuple(view.camera.name for view in group.targets),
                old,
                new,
                pixels_text(group.targets),
            )
            for group, old, new in zip(self.groups, self.before, self.best, strict=True)
        )

    def _psnrs(self, splats: Splats) -> list[float]:
        model = concatenated(prepare(splats), self.surroundings)
        return [group.psnr(model) for group in self.groups]


def fit(
    small: Splats,
    fitting: Fitting,
    deciding: Sequence[ViewGroup],
    parameters: RefitParameters,
    on_progress: PartProgress,
    shared: "SharedHarmonics | None" = None,
) -> Fitted:
    """Fit a model in rounds.

    Args:
        small: The model.
        fitting: Views to fit to.
        deciding: Validation views, which decide how much of each round is kept.
        parameters: Rounds, steps, rate, damping and ridges; see `RefitParameters`.
        on_progress: Progress callback: number of steps made, and their largest possible number.
        shared: Which splats share their higher harmonics, as they must do in `small` already; by
            default each has its own.

    Returns:
        The fitted model, or the input itself if nothing improved it, with what was found.
    """
    validator = Validator(small, deciding, fitting.surroundings, shared)
    descent = descent_for(small, fitting, parameters, shared)
    best: State | None = None  # None is the input
    rate = parameters.rate
    reports: list[RoundReport] = []
    stop = RefitStop.ROUNDS
    for number in range(parameters.rounds):
        begin, before = time.perf_counter(), _mean(validator.best)
        reached, errors = _round(descent, rate, number, on_progress)
        curvatures = descent.curvatures()
        last = number == parameters.rounds - 1
        if last:
            descent.release()
        best, share = _line_search(validator, best, small, reached)
        if best is not None and not last and share == 1:
            best = best.copy()  # because the descent continues to change its state in place
        reports.append(
            RoundReport(
                fitted=FITTED,
                steps=len(errors),
                rate=rate,
                fit_psnr=_psnr(_mean(errors)),
                psnr_before=before,
                psnr_after=_mean(validator.best),
                share=share,
                seconds=time.perf_counter() - begin,
            )
        )
        if share < 1 and not last:
            descent.begin(best or start(small))
        if share < 1:
            rate *= SHORTER if share else SHORTEST
        if rate < LEAST * parameters.rate and not share:
            stop = RefitStop.OPTIMUM
            break
    improved = any(report.share for report in reports)
    nothing = "No step of the fit improved the validation views, so the model was not changed."
    notes = range_notes(best) if best else (nothing,)
    outcome = FitOutcome(
        groups=validator.reports(),
        psnr_before=_mean(validator.before),
        psnr_after=_mean(validator.best),
        improved=improved,
        rounds=tuple(reports),
        stop=stop,
        notes=notes,
    )
    return Fitted(validator.delivered(best) if best else small, curvatures, outcome)


def _line_search(
    validator: Validator, best: State | None, small: Splats, state: State
) -> tuple[State | None, float]:
    """Search from the end of a round back to the best state for a state that the validator accepts.

    Args:
        validator: Accepts or rejects states.
        best: The best state so far; None is the input.
        small: The input.
        state: The state at the end of the round.

    Returns:
        The new best state, and its share of the way to `state`: 0 if nothing was accepted.
    """
    for share in SHARES:
        between = state if share == 1 else (best or start(small)).towards(state, share)
        if validator.accepts(between):
            return between, share
    return best, 0.0


def _round(
    descent: Descent, rate: float, number: int, on_progress: PartProgress
) -> tuple[State, list[float]]:
    """Take the steps of one round; return the state at its end, and the error at each step.

    The learning-rate schedule spans all rounds. The states of the last fifth of all steps are
    averaged, those of the last round at most; with fewer than 5 steps in all there are none.
    """
    steps = descent.parameters.steps
    total = steps * descent.parameters.rounds
    averaged = max((1 - AVERAGED) * total, total - steps)
    errors, end = list[float](), (number + 1) * steps
    for i in range(number * steps, end):
        on_progress(i, total)
        errors.append(descent.step(rate, i / total))
        if i >= averaged:
            descent.add_to_mean()
    return descent.mean() if end - 1 >= averaged else descent.state, errors


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _psnr(error: float) -> float:
    return math.inf if error == 0 else -10 * math.log10(error)
