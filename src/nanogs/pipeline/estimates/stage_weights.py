"""Weights of the stages for progress: how long they take relative to each other.

Weights are seconds of one machine, to about a factor of two, so that a progress bar moves evenly
enough. No Numba here: the command plans with them before it is imported.
"""

from dataclasses import dataclass

from nanogs.fit.stages import refit_stages
from nanogs.io.registry import META
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.options.presets import fit_parameters
from nanogs.progress import Stage
from nanogs.protocol import VIEWS

SIZES, RESULTS = 4, 2  # expected files of a search for a size: of plain cuts, and of results
PACKINGS = 4  # expected results of a search for the best packing
COUNTS = 4  # expected counts of a search for a PSNR: of plain cuts, and again of results
_MILLION = 1e6


@dataclass(frozen=True, slots=True)
class Load:
    """The size of the work, from which its duration is estimated.

    Attributes:
        parameters: Of the method.
        splats: Of the model, millions.
        left: Of the result, millions.
        encoding: Seconds for a million splats of a result that is made in chunks.
    """

    parameters: ForestParameters
    splats: float
    left: float
    encoding: float = 1.0


def looking_seconds(load: Load) -> float:
    """Estimate the seconds of rendering the original from the views that are kept."""
    large = 2 * load.parameters.views + load.parameters.pictured
    return large * _render(load) + load.parameters.around * 0.06 * load.splats


def fitting_seconds(load: Load) -> float:
    """Estimate the seconds of fitting a result."""
    chosen, parameters = fit_parameters(load.parameters), load.parameters
    fit = refit_stages(chosen, round(1e6 * load.splats), round(1e6 * load.left))[-1]
    drawn = 0 if parameters.pictured else min(parameters.further, parameters.steps)
    return fit.weight + drawn * _render(load)


def trying_seconds(load: Load) -> float:
    """Estimate the seconds of measuring the cuts of all balances."""
    return len(load.parameters.balances) * judging_seconds(load)


def judging_seconds(load: Load) -> float:
    """Estimate the seconds of measuring one candidate."""
    return 0.01 + 0.2 * load.splats + 1.5 * load.left


def correcting_seconds(load: Load) -> float:
    """Estimate the seconds of correcting the errors of a cut."""
    views = load.parameters.views + load.parameters.pictured
    return views * (0.006 * (load.parameters.view_size / 512) ** 2 + 0.15 * load.left)


def reassigning_seconds(load: Load) -> float:
    """Estimate the seconds of reassigning the splats after a cut."""
    return (0.1 + 0.6 * load.parameters.rounds) * load.splats


def chunking_seconds(load: Load) -> float:
    """Estimate the seconds of encoding a result in chunks."""
    return load.encoding * load.left


def published_stages(splats: int) -> list[Stage]:
    """Return the stages of the published method."""
    millions = splats / _MILLION
    steps = (("prune", 0.1), ("activate", 0.3), ("merge", 10), ("store", 0.1))
    return [Stage(name, weight * millions) for name, weight in steps]


def level_stage(number: int) -> str:
    """Return the name of the stage of a level, which is that of its file."""
    return f"level_{number}"


def read_weight(splats: int) -> float:
    """Return the weight of reading a file."""
    return 0.6 * splats / _MILLION


def write_weight(suffix: str, splats: int) -> float:
    """Return the weight of writing a file; SOG takes longer, because it computes a palette."""
    millions = splats / _MILLION
    return 1 + 25 * millions if suffix in (".sog", ".json", META) else 0.3 * millions


def measure_stage(splats: int) -> Stage:
    """Return the stage of rendering the original on the views that results are judged by."""
    return Stage("measure", VIEWS * (0.02 + 0.15 * splats / _MILLION))


def _render(load: Load) -> float:
    """Estimate the seconds of one view of the original."""
    return 0.015 * (load.parameters.view_size / 512) ** 2 + 0.06 * load.splats
