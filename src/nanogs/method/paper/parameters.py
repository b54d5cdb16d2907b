"""Parameters of the published method (arXiv 2603.16103)."""

import math
from dataclasses import dataclass

from nanogs.errors import OptionError
from nanogs.ranges import check_ranges, parameter

GRAPHS = ("knn", "random")


@dataclass(frozen=True, slots=True)
class PaperParameters:
    """The parameters of the published method, with its defaults (arXiv 2603.16103).

    Attributes:
        tau: Splats with alpha below min(tau, median alpha) are pruned; 0 prunes none.
        k: Number of neighbours of each splat in the graph.
        graph: Kind of neighbours: the nearest ("knn"), or random ones ("random", to measure the
            effect of the graph).
        samples: Number of Monte Carlo samples from each splat of a pair for the divergence.
        seed: Seed of those samples, and of random neighbours.
        lambda_geo: Weight of the geometry's divergence.
        lambda_app: Weight of the squared colour distance.
        merge_cap: Largest share of the splats that may be merged away in one pass.
    """

    tau: float = parameter(0.1, 0, 1, help="Prune splats with an alpha below this and the median.")
    k: int = parameter(16, 1, help="Nearest neighbours that a splat may merge with.")
    graph: str = "knn"
    samples: int = parameter(1, 1, help="Monte Carlo samples from each of two splats.")
    seed: int = parameter(0, high=math.inf, help="Seed of the samples.")
    lambda_geo: float = parameter(1.0, help="Weight of geometry in the cost of a merge.")
    lambda_app: float = parameter(1.0, help="Weight of colour in the cost of a merge.")
    merge_cap: float = parameter(
        0.5, 0, 0.5, above=True, help="Largest share of the splats that a pass may merge away."
    )

    def __post_init__(self) -> None:
        """Check the ranges of the parameters."""
        check_ranges(self)
        if self.graph not in GRAPHS:
            raise OptionError(f"graph must be {' or '.join(GRAPHS)}, not {self.graph!r}.")
