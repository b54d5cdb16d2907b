"""The report of a simplification: frozen dataclasses that become JSON as they stand."""

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from operator import attrgetter
from typing import Any

from nanogs.costs import DrawCost
from nanogs.filters import FilterReport
from nanogs.fit.report import RefitReport
from nanogs.formatting import counted, time_text
from nanogs.protocol import Judged, PackingLoss


class StopReason(StrEnum):
    """Why the loop of passes, or the search for a size, a PSNR or a draw cost, ended."""

    TARGET = "target"  # the asked count is reached
    NO_CANDIDATES = "no_candidates"  # no pair is left whose cost is a number
    NO_PROGRESS = "no_progress"  # a pass merged nothing although candidates were left
    STEP = "step"  # what was asked is stepped over: a hundredth of the splats more or less misses
    UNREACHED = "unreached"  # 99 % of the splats miss the asked PSNR; the whole model was delivered
    PROBES = "probes"  # enough counts were tried; a smaller one may reach the asked PSNR too
    SETTLED = "settled"  # enough counts were tried; a larger one may fit into the asked size too

    @property
    def met(self) -> bool:
        """Whether what was asked for is what was delivered."""
        return self in (StopReason.TARGET, StopReason.STEP, StopReason.SETTLED)


@dataclass(frozen=True, slots=True)
class PassReport:
    """One pass of graph, cost, match and merge.

    Attributes:
        count_before: Splats at its start.
        candidates: Pairs of neighbours.
        without_cost: Pairs left out because their cost is not a number.
        merged: Pairs that became one splat each.
        count_after: Splats at its end.
        highest_cost: Cost of the dearest merge (dimensionless), or None where none was made.
        seconds: Time by stage, seconds.
    """

    count_before: int
    candidates: int
    without_cost: int
    merged: int
    count_after: int
    highest_cost: float | None
    seconds: dict[str, float]

    @property
    def stop(self) -> StopReason:
        """Why merging ends with it, if it has merged nothing."""
        tried = self.candidates > self.without_cost
        return StopReason.NO_PROGRESS if tried else StopReason.NO_CANDIDATES


@dataclass(frozen=True, slots=True)
class CandidateReport:
    """One of the results that were rendered and held against the original.

    Attributes:
        balance: Of its cut, from groups of equal size (0) to groups of equal error (1).
        reassigned: Whether splats were moved between groups after the cut.
        growth: Most that the axes of a splat could grow that cannot be opaque enough.
        psnr: Mean over the small views it is chosen by, dB; not what `compare` measures.
        ssim: Mean over these views.
        quality: What was compared, dB: PSNR and what SSIM is worth.
        chosen: Whether it is the result.
    """

    balance: float
    reassigned: bool
    growth: float
    psnr: float
    ssim: float
    quality: float
    chosen: bool


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """A count that was tried on the way to an asked PSNR.

    Attributes:
        count: Splats of the result.
        psnr: Of the result, as `SimplifyReport.judged` has it, dB.
        quick: Whether it was a plain cut, to come near the count; else it was made as results are
            delivered.
    """

    count: int
    psnr: float
    quick: bool = False


@dataclass(frozen=True, slots=True)
class DrawProbeReport:
    """A count that was tried on the way to an asked draw cost.

    Attributes:
        count: Splats of the result.
        share: Splats a pixel of the result, as a share of the original's.
        quick: As `ProbeReport` has it.
    """

    count: int
    share: float
    quick: bool = False


@dataclass(frozen=True, slots=True)
class SizeProbeReport:
    """A count that was tried on the way to an asked size.

    Attributes:
        count: Splats of the result.
        bytes: Its file.
    """

    count: int
    bytes: int


@dataclass(frozen=True, slots=True)
class PackingReport:
    """A way of packing that was tried for a size.

    Attributes:
        sh_degree: Of the spherical harmonics that are written.
        options: Of the format, by name.
        count: Splats of the result, a plain cut.
        bytes: Its file.
        psnr: Of the file as it is read back, on views by which is chosen, dB; not what `compare`
            measures.
        ssim: Over the same views.
    """

    sh_degree: int
    options: dict[str, int]
    count: int
    bytes: int
    psnr: float
    ssim: float


@dataclass(frozen=True, slots=True)
class BlocksReport:
    """How a model that was not held whole was divided.

    Attributes:
        blocks: How many there were.
        largest: Splats of the largest.
        allowed: Most splats that a block might have had.
        segments: Pieces of the input that were sorted.
        seen: Splats that blocks saw of others, in all.
        handed: Splats that moved to a group of another block.
        resumed: Tasks that a run before had done.
    """

    blocks: int
    largest: int
    allowed: int
    segments: int
    seen: int
    handed: int
    resumed: int


@dataclass(frozen=True, slots=True)
class SimplifyReport:
    """The report of `simplify`: what was asked, what was delivered, and why it stopped.

    Attributes:
        preset: Name of the preset.
        parameters: Every parameter of the method by name.
        input_count: Splats in the input.
        asked_ratio: The compaction ratio asked for, or None.
        asked_count: The count asked for, or what a ratio (ceil(ratio x finite splats)), a size or
            a PSNR comes to.
        dropped_nonfinite: Splats left out since a value is NaN or infinite.
        pruned: Splats dropped by the opacity threshold.
        prune_threshold: Alpha below which splats were pruned, in [0, 1].
        prune_limited: The threshold would have gone below the asked count; the most opaque
            splats were kept instead.
        passes: The passes in order.
        achieved_count: Splats in the output.
        stop: Why it stopped.
        seconds: Time by stage over all passes, seconds.
        total_seconds: The whole call, seconds.
        threads: Threads used.
        shown: Share of the model's prominence, which is alpha times footprint as large as screens
            show it from where viewers stand, that has splats which the views show to a hundredth or
            more: others are hidden or outside. None where none was rendered.
        candidates: What was rendered to choose the result, in the order tried; none where the
            method does not measure.
        refit: What fitting the result to the original gained (see `nanogs.refit`), or None.
        notes: What else the user should know, one sentence each.
        asked_size: The largest size of the file asked for, bytes, or None.
        asked_psnr: The PSNR asked for, dB, or None.
        probes: The counts tried for a PSNR, in order.
        achieved_size: Bytes of the result's file, at most the size asked for; None where none was.
        size_probes: The counts written to find one that fits, in order; none where the size of a
            file is known beforehand.
        packings: The ways of packing that were tried for a size, in order.
        format_options: Options of the format that were chosen for a size, and by which the result
            has to be saved to have it.
        blocks: How the model was divided, or None where it was held whole.
        read_count: Splats of the inputs, before filters.
        filters: What each filter took.
        judged: The result held against the input as `nanogs compare` does it, on views that nothing
            was learnt from; None where that was not measured, as it is only for an asked PSNR.
        packed: Where that is the file's, in a format that rounds: what packing alone cost, beside
            the same result unpacked; else None.
        asked_draw_cost: The most that was asked for of the original's splats a pixel, as a share,
            or None.
        draw_probes: The counts tried for that, in order.
        cost: What the result takes to draw, on the views of `nanogs compare`; None where that was
            not measured.
        original_cost: The same of the input.
        reassign_rounds: Rounds of reassignment in which splats moved, of blocks the most of any:
            fewer than the parameter `rounds` where nothing moved any more. None without any.
    """

    preset: str
    parameters: dict[str, float | int | str | bool]
    input_count: int
    asked_ratio: float | None
    asked_count: int
    dropped_nonfinite: int
    pruned: int
    prune_threshold: float
    prune_limited: bool
    passes: tuple[PassReport, ...]
    achieved_count: int
    stop: StopReason
    seconds: dict[str, float]
    total_seconds: float
    threads: int
    shown: float | None = None
    candidates: tuple[CandidateReport, ...] = ()
    refit: RefitReport | None = None
    notes: tuple[str, ...] = ()
    asked_size: int | None = None
    asked_psnr: float | None = None
    probes: tuple[ProbeReport, ...] = ()
    achieved_size: int | None = None
    size_probes: tuple[SizeProbeReport, ...] = ()
    packings: tuple[PackingReport, ...] = ()
    format_options: dict[str, int] = field(default_factory=dict)
    blocks: BlocksReport | None = None
    read_count: int = 0
    filters: tuple[FilterReport, ...] = ()
    judged: Judged | None = None
    packed: PackingLoss | None = None
    asked_draw_cost: float | None = None
    draw_probes: tuple[DrawProbeReport, ...] = ()
    cost: DrawCost | None = None
    original_cost: DrawCost | None = None
    reassign_rounds: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and strings, as `json.dumps` takes them."""
        return asdict(self)

    def __str__(self) -> str:
        """One line: the counts, how near the result is if that was measured, and the time."""
        counts = f"{self.input_count:,} -> {counted(self.achieved_count, 'splat')}"
        text = ", ".join([counts, *measures(self), time_text(self.total_seconds)])
        return text if self.stop.met else f"{text}. {stop_text(self)}"


def measures(report: SimplifyReport) -> list[str]:
    """Texts of all that was measured: how near it is, what packing cost, what it takes to draw."""
    texts = [measured.text for measured in (report.judged, report.packed) if measured]
    if report.cost is not None and report.original_cost is not None:
        share = report.cost.share_of(report.original_cost)
        texts.append(f"{share:.1%} of the splats a pixel ({report.cost.splats_a_pixel:.1f})")
    return texts


def stop_text(report: SimplifyReport) -> str:
    """Why a result is not what was asked for, in one sentence."""
    if report.stop == StopReason.UNREACHED:
        return (
            f"99 % of the splats do not reach {report.asked_psnr:g} dB{_nearest_text(report)}, so"
            f" the whole model was written (stop: {report.stop})."
        )
    if report.stop == StopReason.PROBES and report.asked_draw_cost is not None:
        return (
            f"The search for the most splats ended after {len(report.draw_probes)} counts; what was"
            " written takes no more to draw than was asked, and more may too (stop:"
            f" {report.stop})."
        )
    if report.stop == StopReason.PROBES:
        return (
            f"The search for the fewest splats ended after {len(report.probes)} counts; what was "
            f"written reaches {report.asked_psnr:g} dB, and fewer may too (stop: {report.stop})."
        )
    return f"Stopped before the asked count: {report.stop}."


def _nearest_text(report: SimplifyReport) -> str:
    """The PSNR of the largest count that was tried, in words."""
    if not report.probes:
        return ""
    most = max(report.probes, key=attrgetter("count"))
    of = counted(report.input_count, "splat has", "splats have")
    return f" ({most.count:,} of {of} {most.psnr:.2f} dB)"
