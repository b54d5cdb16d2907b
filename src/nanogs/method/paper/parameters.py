"""Parameters of the published method (arXiv 2603.16103)."""

import math
from dataclasses import dataclass

from nanogs.errors import OptionError, require

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
        require(0 <= self.tau <= 1, "tau", self.tau, "an opacity from 0 to 1")
        require(self.k >= 1, "k", self.k, "at least 1")
        if self.graph not in GRAPHS:
            raise OptionError(f"graph must be {' or '.join(GRAPHS)}, not {self.graph!r}.")
        require(self.samples >= 1, "samples", self.samples, "at least 1")
        require(self.seed >= 0, "seed", self.seed, "0 or more")
        for name in ("lambda_geo", "lambda_app"):
            value = getattr(self, name)
            require(0 <= value < math.inf, name, value, "0 or more, and finite")
        require(0 < self.merge_cap <= 0.5, "merge_cap", self.merge_cap, "above 0, at most 0.5")
