"""The stages of a simplification, and how long each takes beside the others.

Weights are seconds of one machine, to about a factor of two: a bar that follows them moves evenly
enough. No Numba here: the command plans with them before it is imported.
"""

from collections.abc import Sequence

from nanogs.fit.parameters import RefitParameters
from nanogs.fit.stages import refit_stages
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.presets import Parameters, renders
from nanogs.pipeline.target import Goal
from nanogs.progress import Stage
from nanogs.protocol import VIEWS

ROUND = 32  # steps of the fit, about: what each of its rounds makes
SIZES, RESULTS = 4, 2  # files that a search for a size writes: of plain cuts, and of results
COUNTS = 4  # that a search for a PSNR tries, of plain cuts and again of results
_MILLION = 1e6


def simplify_stages(
    parameters: Parameters, goal: Goal, splats: int, count: int | None, suffix: str
) -> list[Stage]:
    """The stages of `simplify`.

    Args:
        parameters: Of the method.
        goal: What is asked.
        splats: Of the model.
        count: What the goal comes to, or None where only a search can tell.
        suffix: Of the file that a size is about.
    """
    if isinstance(parameters, PaperParameters) or count is not None:
        each = delivery_stages(parameters, splats, count or splats)
        return [*build_stages(parameters, splats), *each]
    typical = splats // 10
    weight = _sum(delivery_stages(parameters, splats, typical))
    if goal.psnr is not None:
        quick = 0.1 + 0.4 * splats / _MILLION
        stages = [measure_stage(splats), *build_stages(parameters, splats)]
        stages.append(Stage("search", COUNTS * quick))
        if renders(parameters):
            stages.append(Stage("deliver", COUNTS * (weight + 0.1)))
        return stages
    writing = write_weight(suffix, typical)
    search = [Stage("search", SIZES * (writing + 0.3 * splats / _MILLION))]
    if renders(parameters):
        search.append(Stage("deliver", RESULTS * (writing + weight)))
    return [Stage("guess", writing / 5), *build_stages(parameters, splats), *search]


def levels_stages(parameters: Parameters, splats: int, counts: Sequence[int]) -> list[Stage]:
    """The stages of `levels`: what is done once, and each level."""
    each = [_sum(delivery_stages(parameters, splats, count)) for count in counts]
    levels = [Stage(level_stage(number), weight) for number, weight in enumerate(each)]
    return [*build_stages(parameters, splats), *levels]


def level_stage(number: int) -> str:
    """Name the stage of a level, as its file is named."""
    return f"level_{number}"


def build_stages(parameters: Parameters, splats: int) -> list[Stage]:
    """Stages done once for any count: the original is looked at, and its forest grown."""
    if isinstance(parameters, PaperParameters):
        return []  # it does all of it for each
    millions = splats / _MILLION
    look = [_look(parameters, splats)] if renders(parameters) else []
    return [*look, Stage("activate", 0.35 * millions), Stage("grow", 3 * millions)]


def delivery_stages(parameters: Parameters, splats: int, count: int) -> list[Stage]:
    """Stages done for each count."""
    if isinstance(parameters, PaperParameters):
        return _published_stages(splats)
    all_of_them, left = splats / _MILLION, count / _MILLION
    if parameters.measure:
        stages = [Stage("choose", 0.05 + 1.3 * all_of_them + 7.5 * left)]
    else:
        moved = 3 * parameters.rounds
        stages = [Stage("cut", (0.1 + moved) * all_of_them), Stage("store", 0.2 * all_of_them)]
    if parameters.steps:
        fit = refit_stages(fit_parameters(parameters), splats, count)[-1]
        drawn = min(parameters.further, parameters.steps)
        stages.append(Stage("fit", fit.weight + drawn * _render(parameters, splats)))
    return stages


def fit_parameters(parameters: ForestParameters) -> RefitParameters:
    """How a result is fitted that has been chosen."""
    rounds = max(1, round(parameters.steps / ROUND))
    return RefitParameters(
        views=parameters.views,
        size=parameters.view_size,
        rounds=rounds,
        steps=-(-parameters.steps // rounds),
        halves=not parameters.further,  # few views, which come again
    )


def _published_stages(splats: int) -> list[Stage]:
    millions = splats / _MILLION
    steps = (("prune", 0.1), ("activate", 0.3), ("merge", 10), ("store", 0.1))
    return [Stage(name, weight * millions) for name, weight in steps]


def read_weight(splats: int) -> float:
    """The stage of reading a file."""
    return 0.6 * splats / _MILLION


def write_weight(suffix: str, splats: int) -> float:
    """The stage of writing a file; SOG looks for a palette."""
    millions = splats / _MILLION
    return 1 + 25 * millions if suffix in (".sog", "meta.json") else 0.3 * millions


def measure_stage(splats: int) -> Stage:
    """Rendering the original on the views that results are judged by."""
    return Stage("measure", VIEWS * (0.02 + 0.15 * splats / _MILLION))


def _sum(stages: list[Stage]) -> float:
    return sum(stage.weight for stage in stages)


def _look(parameters: ForestParameters, splats: int) -> Stage:
    roaming = parameters.roaming * (0.01 + 0.3 * splats / _MILLION)  # found by trying
    return Stage("look", roaming + 2 * parameters.views * _render(parameters, splats))


def _render(parameters: ForestParameters, splats: int) -> float:
    """One view of the original."""
    return 0.015 * (parameters.view_size / 512) ** 2 + 0.06 * splats / _MILLION
