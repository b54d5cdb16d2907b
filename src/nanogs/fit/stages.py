"""The stages of a refit and their expected durations, for progress reports."""

from nanogs.fit.parameters import RefitParameters
from nanogs.progress import Stage


def refit_stages(parameters: RefitParameters, original: int, count: int) -> list[Stage]:
    """Return the stages of `refit`, each with its expected duration relative to the other.

    Args:
        parameters: Parameters of the fit.
        original: Number of splats of the original.
        count: Number of splats of the model that is fitted.
    """
    pixels = (parameters.size / 512) ** 2
    seen = parameters.kept + parameters.held
    looks = parameters.rounds * parameters.steps
    drawn = min(parameters.views - parameters.kept, looks)
    render = 0.02 * pixels + 0.1 * original / 1e6
    return [
        Stage("render", seen * render),
        Stage("fit", looks * (0.06 * pixels + 0.6 * count / 1e6) + drawn * render),
    ]
