"""Named sets of parameters."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeAlias

from nanogs.errors import OptionError, did_you_mean

GRAPHS = ("knn", "random")


@dataclass(frozen=True, slots=True)
class PaperParameters:
    """The parameters of the published method, with its defaults (arXiv 2603.16103).

    Attributes:
        tau: Splats with alpha below min(tau, median alpha) are pruned; 0 prunes none.
        k: Neighbours of each splat in the graph.
        graph: Which these are: the nearest ("knn"), or drawn at random ("random"; to measure what
            nearness is worth).
        samples: Monte Carlo samples from each splat of a pair in the divergence.
        seed: Seed of those samples, and of random neighbours.
        lambda_geo: Weight of the divergence of the geometry.
        lambda_app: Weight of the squared distance of the colours.
        merge_cap: Largest share of the splats that may be merged away in one pass.
    """

    tau: float = 0.1
    k: int = 16
    graph: str = "knn"
    samples: int = 1
    seed: int = 0
    lambda_geo: float = 1.0
    lambda_app: float = 1.0
    merge_cap: float = 0.5

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        _require(0 <= self.tau <= 1, "tau", self.tau, "an opacity from 0 to 1")
        _require(self.k >= 1, "k", self.k, "at least 1")
        if self.graph not in GRAPHS:
            raise OptionError(f"graph must be {' or '.join(GRAPHS)}, not {self.graph!r}.")
        _require(self.samples >= 1, "samples", self.samples, "at least 1")
        _require(self.seed >= 0, "seed", self.seed, "0 or more")
        for name in ("lambda_geo", "lambda_app"):
            value = getattr(self, name)
            _require(0 <= value < math.inf, name, value, "0 or more, and finite")
        _require(0 < self.merge_cap <= 0.5, "merge_cap", self.merge_cap, "above 0, at most 0.5")


USUAL_BALANCE = 0.8  # the safest where nothing is measured


@dataclass(frozen=True, slots=True)
class ForestParameters:
    """The parameters of the default method (`docs/method.md`).

    Attributes:
        k: Neighbours of each node in the graph.
        lambda_app: Weight of the colour's error beside the geometry's while the forest grows.
        balance: Of the cut, from groups of equal size (0) to groups of equal error (1). Where
            results are measured 0.5 and 1 are tried, and this beside them if it is not the usual
            one.
        rounds: Rounds of reassignment after the cut.
        pixels: Across a splat's surroundings, the ball about it that holds a quarter of the alpha,
            where the model is seen as a whole: rasterisers widen what is thinner than a pixel, and
            what is merged must cover as much there and four times as near.
        hidden: Weight of a splat that no view sees over that of one in full sight, above 0; 1
            weighs all alike.
        growth: Most that a merged splat's two longer axes may grow where an opaque one would cover
            too little; where nothing is measured, pieces of flat sheets grow by what they need, up
            to 1.8.
        measure: Render the original: weigh splats by what is seen of them, and choose between
            results by how they look.
        steps: Of fitting the result to the original, each on one view; a long fit is made in
            rounds of about 32, so that it may take a few more; 0 fits nothing.
        views: Views of the original to look at, where it is rendered: for what is hidden, to choose
            by and to fit to; one in six of them decides.
        further: More views to fit to, each drawn when its turn comes.
        roaming: Small views from anywhere in free space, that only say what is hidden.
        view_size: Pixels along the longer side of a view.
    """

    k: int = 8
    lambda_app: float = 1.0
    balance: float = USUAL_BALANCE
    rounds: int = 2
    pixels: float = 512.0
    hidden: float = 0.03
    growth: float = 1.25
    measure: bool = True
    steps: int = 28
    views: int = 14
    further: int = 0
    roaming: int = 0
    view_size: int = 896

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        _require(self.k >= 1, "k", self.k, "at least 1")
        _require(0 <= self.lambda_app < math.inf, "lambda_app", self.lambda_app, "0 or more")
        _require(0 <= self.balance <= 1, "balance", self.balance, "from 0 to 1")
        _require(self.rounds >= 0, "rounds", self.rounds, "0 or more")
        _require(0 < self.pixels < math.inf, "pixels", self.pixels, "above 0, and finite")
        _require(0 < self.hidden <= 1, "hidden", self.hidden, "above 0, at most 1")
        _require(1 <= self.growth < math.inf, "growth", self.growth, "1 or more, and finite")
        _require(self.steps >= 0, "steps", self.steps, "0 or more")
        _require(self.views >= 1, "views", self.views, "at least 1")
        _require(self.further >= 0, "further", self.further, "0 or more")
        _require(self.roaming >= 0, "roaming", self.roaming, "0 or more")
        _require(16 <= self.view_size <= 8192, "view_size", self.view_size, "16 to 8192 pixels")


Parameters: TypeAlias = PaperParameters | ForestParameters


def _require(ok: bool, name: str, value: float, expected: str) -> None:
    if not ok:
        raise OptionError(f"{name} must be {expected}, not {value:g}.")


PRESETS: Mapping[str, Parameters] = MappingProxyType(
    {
        "default": ForestParameters(),
        "fast": ForestParameters(rounds=1, measure=False, steps=0),
        # It looks from anywhere, and so is surer of what is hidden.
        "best": ForestParameters(
            hidden=0.01, steps=224, views=24, further=204, roaming=24, view_size=768
        ),
        "paper": PaperParameters(),
    }
)
"""The parameters of each preset, by its name; `nanogs.presets`."""
SUMMARIES: Mapping[str, str] = {
    "default": "one merge forest; the cut that looks most like the original, fitted a little",
    "fast": "the same forest, one cut, nothing rendered",
    "best": "default with a new view for every step of a long fit; takes 4 to 5 times as long",
    "paper": "NanoGS as published",
}
DEFAULT_PRESET = "default"


def parameters(preset: str, overrides: Mapping[str, Any]) -> Parameters:
    """The preset's parameters with some of them replaced.

    Args:
        preset: A name in `PRESETS`.
        overrides: Parameters by name; None leaves the preset's value.

    Raises:
        OptionError: No such preset or parameter, or a value out of its range.
    """
    if preset not in PRESETS:
        meant = did_you_mean(preset, PRESETS)
        raise OptionError(
            f"There is no preset {preset!r}{meant}; choose one of {', '.join(PRESETS)}."
        )
    given = {name: value for name, value in overrides.items() if value is not None}
    known = [entry.name for entry in dataclasses.fields(PRESETS[preset])]
    for name in given:
        if name not in known:
            raise OptionError(
                f"The preset {preset} has no parameter {name!r}{did_you_mean(name, known)};"
                f" choose from {', '.join(known)}."
            )
    return dataclasses.replace(PRESETS[preset], **given)


def refuse_search(preset: str, wish: str) -> None:
    """Only a forest answers many counts for the price of one.

    Args:
        preset: Its name.
        wish: What is asked for and has to be searched, for the message.

    Raises:
        OptionError: The preset grows none.
    """
    if not isinstance(PRESETS[preset], ForestParameters):
        raise OptionError(
            f"The preset {preset} cannot be asked for {wish}, since each count tried would be a "
            "run of its own; choose another preset."
        )


def effective(chosen: Parameters) -> dict[str, Any]:
    """The parameters that have an effect, by name: without views, none that is about views."""
    unused: set[str] = set()
    if isinstance(chosen, ForestParameters) and not chosen.measure:
        views = {"steps", "views", "further", "roaming", "view_size"}
        unused = {"hidden"} if chosen.steps else {"hidden"} | views
    return {name: value for name, value in dataclasses.asdict(chosen).items() if name not in unused}


def renders(chosen: Parameters) -> bool:
    """Whether a method looks at views of the original."""
    return isinstance(chosen, ForestParameters) and (chosen.measure or chosen.steps > 0)
