"""The outcome of any method, whatever its stages."""

from dataclasses import dataclass

from nanogs.fit.report import RefitReport
from nanogs.protocol import Judged
from nanogs.report import (
    CandidateReport,
    PassReport,
    ProbeReport,
    SizeProbeReport,
    StopReason,
)
from nanogs.splats import Splats


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A smaller model and what its report needs; see `SimplifyReport` for the fields."""

    splats: Splats
    passes: tuple[PassReport, ...]
    stop: StopReason
    pruned: int = 0
    prune_threshold: float = 0.0
    prune_limited: bool = False
    shown: float | None = None
    candidates: tuple[CandidateReport, ...] = ()
    refit: RefitReport | None = None
    notes: tuple[str, ...] = ()
    judged: Judged | None = None
    probes: tuple[ProbeReport, ...] = ()
    achieved_size: int | None = None
    size_probes: tuple[SizeProbeReport, ...] = ()
