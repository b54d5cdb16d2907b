"""The stages of a refit, and how long each takes beside the others."""

from nanogs.fit.parameters import RefitParameters
from nanogs.progress import Stage


def refit_stages(parameters: RefitParameters, original: int, count: int) -> list[Stage]:
    """The stages of `refit`.

    Args:
        parameters: Of the fit.
        original: Splats of the original.
        count: Splats of the model that is fitted.
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
