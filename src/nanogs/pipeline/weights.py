"""How long stages take beside each other, and how a result is fitted.

Weights are seconds of one machine, to about a factor of two: a bar that follows them moves evenly
enough. No Numba here: the command plans with them before it is imported.
"""

from dataclasses import dataclass

from nanogs.fit.parameters import RefitParameters
from nanogs.fit.stages import refit_stages
from nanogs.method.parameters import ForestParameters
from nanogs.progress import Stage
from nanogs.protocol import VIEWS
from nanogs.views.stand_in import AFAR

ROUND = 32  # steps of the fit, about: what each of its rounds makes
SIZES, RESULTS = 4, 2  # files that a search for a size writes: of plain cuts, and of results
PACKINGS = 4  # results that a search for the best packing makes
COUNTS = 4  # that a search for a PSNR tries, of plain cuts and again of results
_MILLION = 1e6


@dataclass(frozen=True, slots=True)
class Load:
    """The size of the work, which says about how long it takes.

    Attributes:
        parameters: Of the method.
        splats: Of the model, millions.
        left: Of the result, millions.
    """

    parameters: ForestParameters
    splats: float
    left: float


def roaming_seconds(load: Load) -> float:
    """Choosing views: roaming ones are found by trying."""
    return 0.05 + load.parameters.roaming * (0.01 + 0.3 * min(load.splats, AFAR / _MILLION))


def looking_seconds(load: Load) -> float:
    """Rendering the original from the views that are kept."""
    return (2 * load.parameters.views + load.parameters.pictured) * _render(load)


def fitting_seconds(load: Load) -> float:
    """Fitting a result."""
    chosen, parameters = fit_parameters(load.parameters), load.parameters
    fit = refit_stages(chosen, round(1e6 * load.splats), round(1e6 * load.left))[-1]
    drawn = 0 if parameters.pictured else min(parameters.further, parameters.steps)
    return fit.weight + drawn * _render(load)


def fit_parameters(parameters: ForestParameters) -> RefitParameters:
    """How a result is fitted that has been chosen."""
    rounds = max(1, round(parameters.steps / ROUND))
    return RefitParameters(
        views=parameters.views,
        size=parameters.view_size,
        rounds=rounds,
        steps=max(-(-parameters.steps // rounds), 1),  # also to plan with, where none is made
        halves=parameters.halves,
    )


def published_stages(splats: int) -> list[Stage]:
    """The stages of the published method."""
    millions = splats / _MILLION
    steps = (("prune", 0.1), ("activate", 0.3), ("merge", 10), ("store", 0.1))
    return [Stage(name, weight * millions) for name, weight in steps]


def level_stage(number: int) -> str:
    """Name the stage of a level, as its file is named."""
    return f"level_{number}"


def read_weight(splats: int) -> float:
    """The stage of reading a file."""
    return 0.6 * splats / _MILLION


def write_weight(suffix: str, splats: int) -> float:
    """The stage of writing a file; SOG looks for a palette."""
    millions = splats / _MILLION
    return 1 + 25 * millions if suffix in (".sog", ".json", "meta.json") else 0.3 * millions


def measure_stage(splats: int) -> Stage:
    """Rendering the original on the views that results are judged by."""
    return Stage("measure", VIEWS * (0.02 + 0.15 * splats / _MILLION))


def _render(load: Load) -> float:
    """One view of the original."""
    return 0.015 * (load.parameters.view_size / 512) ** 2 + 0.06 * load.splats
