"""The report of a simplification: frozen dataclasses that convert directly to JSON."""

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
    STEP = "step"  # no nearer count exists: at most 1 % more or fewer splats jump past the goal
    # 99 % of the splats, or all but one, miss the asked PSNR; the whole model was delivered.
    UNREACHED = "unreached"
    PROBES = "probes"  # the number of tries ran out; a smaller count may reach the asked PSNR too
    SETTLED = "settled"  # the number of tries ran out; a larger count may fit the asked size too

    @property
    def met(self) -> bool:
        """Whether the result meets the request."""
        return self in (StopReason.TARGET, StopReason.STEP, StopReason.SETTLED)


@dataclass(frozen=True, slots=True)
class PassReport:
    """One pass of graph, cost, match and merge.

    Attributes:
        count_before: Number of splats at its start.
        candidates: Number of candidate pairs of neighbours.
        without_cost: Number of pairs left out because their cost is not a number.
        merged: Number of pairs that became one splat each.
        count_after: Number of splats at its end.
        highest_cost: Highest cost of a merge (dimensionless), or None if none was made.
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
        """The reason to stop after this pass, given that it merged nothing."""
        tried = self.candidates > self.without_cost
        return StopReason.NO_PROGRESS if tried else StopReason.NO_CANDIDATES


@dataclass(frozen=True, slots=True)
class CandidateReport:
    """One of the candidate results that were rendered and compared with the original.

    Attributes:
        balance: Balance of its cut, from groups of equal size (0) to groups of equal error (1).
        corrections: How often the errors that the cut is guided by were corrected by those that
            groups show in views; 0 for predicted errors.
        reassigned: Whether splats were moved between groups after the cut.
        growth: Largest factor by which the axes of a splat could grow to make up for an opacity
            that would have to exceed 1.
        psnr: Mean over the small views that candidates are chosen by, dB; not what `compare`
            measures.
        ssim: Mean over these views.
        quality: The score that candidates were ranked by, dB: PSNR plus weighted SSIM.
        chosen: Whether it is the result.
    """

    balance: float
    corrections: int
    reassigned: bool
    growth: float
    psnr: float
    ssim: float
    quality: float
    chosen: bool


@dataclass(frozen=True, slots=True)
class ProbeReport:
    """A count that was tried in the search for a requested PSNR.

    Attributes:
        count: Number of splats of the result.
        psnr: PSNR of the result, measured as for `SimplifyReport.judged`, dB. If the delivered one
            has more than asked, it is then rounded more coarsely, as far as its format allows.
        quick: Whether it was a plain cut, to narrow down the count; else it was made in the same
            way as a delivered result.
    """

    count: int
    psnr: float
    quick: bool = False


@dataclass(frozen=True, slots=True)
class DrawProbeReport:
    """A count that was tried in the search for a requested draw cost.

    Attributes:
        count: Number of splats of the result.
        share: Splats per pixel of the result over those of the original.
        quick: Whether it was a plain cut; see `ProbeReport`.
    """

    count: int
    share: float
    quick: bool = False


@dataclass(frozen=True, slots=True)
class SizeProbeReport:
    """A count that was tried in the search for a requested file size.

    Attributes:
        count: Number of splats of the result.
        bytes: Size of its file.
    """

    count: int
    bytes: int


@dataclass(frozen=True, slots=True)
class PackingReport:
    """A setting of the file format that was tried for a requested file size or PSNR.

    Attributes:
        sh_degree: Degree of the spherical harmonics that are written.
        options: Options of the format by name.
        count: Number of splats of the result, which is fitted in fewer steps than a delivered one.
        bytes: Size of its file.
        psnr: PSNR of the file when read back, on the views that settings are chosen by, dB; not
            what `compare` measures.
        ssim: SSIM over the same views.
        unpacked_psnr: PSNR of the result as it is before it is written, dB.
        unpacked_ssim: Its SSIM.
    """

    sh_degree: int
    options: dict[str, int]
    count: int
    bytes: int
    psnr: float
    ssim: float
    unpacked_psnr: float
    unpacked_ssim: float


@dataclass(frozen=True, slots=True)
class BlocksReport:
    """How a model that was not held whole in memory was divided into blocks.

    Attributes:
        blocks: Number of blocks.
        largest: Number of splats of the largest block.
        allowed: Most splats that a block could have had.
        segments: Number of pieces of the input that were sorted.
        seen: Number of splats that blocks read of their neighbours, summed over the blocks.
        handed: Number of splats that moved to a group of another block.
        resumed: Number of tasks that an earlier run had finished.
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
        parameters: Every parameter of the method by name. If several balances are tried, `balance`
            is not the one of the result: see `candidates`.
        input_count: Number of splats of the model, after filters.
        asked_ratio: The compaction ratio asked for, or None.
        asked_count: The count asked for, or the count found for a ratio
            (ceil(ratio x finite splats)), a size, a PSNR or a draw cost.
        dropped_nonfinite: Number of splats left out because a value is NaN or infinite.
        pruned: Number of splats dropped by the opacity threshold.
        prune_threshold: Alpha below which splats were pruned, in [0, 1].
        prune_limited: Whether the threshold alone would have left fewer than the asked count; then
            the most opaque splats were kept instead.
        passes: The passes in order.
        achieved_count: Number of splats in the output.
        stop: Why it stopped.
        seconds: Time by stage over all passes, seconds.
        total_seconds: Time of the whole call, seconds.
        threads: Number of threads used.
        shown: Share of the model's total prominence that belongs to splats which the views show to
            a hundredth or more; the others are hidden or outside the views. Prominence is alpha
            times footprint, as large as screens show it from the likely places of viewers. None if
            nothing was rendered.
        candidates: The results that were rendered to choose one, in the order tried; empty if it
            is not guided by renders.
        fit: Gain of fitting the result to the original (see `nanogs.refit`), or None.
        notes: Further notes for the user, one sentence each.
        asked_size: The largest file size asked for, bytes, or None.
        asked_psnr: The PSNR asked for, dB, or None.
        probes: The counts tried for a PSNR, in order.
        achieved_size: Bytes of the result's file, at most the size asked for; None if no size was.
        size_probes: The counts written to find one that fits, in order; empty if the size of a file
            is known beforehand.
        packings: The format settings that were tried for a size or a PSNR, in order.
        format_options: The format options that were chosen for a size or a PSNR. The file has that
            size or PSNR only if it is saved with them and with the options that were given.
        blocks: How the model was divided into blocks, or None if it was held whole in memory.
        read_count: Number of splats of the inputs, before filters.
        filters: Number of splats that each filter removed.
        judged: PSNR and SSIM of the result against the input, as by `nanogs compare`, on views that
            nothing was fitted to; None if not measured.
        packed: The loss by packing alone, against the same result unpacked. Measured with `judged`
            if a result made in memory is written to a file of a format that rounds; None for
            levels, in blocks, and if a PSNR was asked for.
        asked_draw_cost: The largest share of the original's splats per pixel that was asked for, or
            None.
        draw_probes: The counts tried for a draw cost, in order.
        cost: Cost of drawing the result on the views of `nanogs compare`; None if not measured.
        original_cost: The same for the input.
        reassign_rounds: Number of rounds of reassignment in which splats moved, the most of any
            block: fewer than the parameter `rounds` if nothing moved any more. None if there were
            none.
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
    fit: RefitReport | None = None
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

    @property
    def met(self) -> bool:
        """Whether the result meets the request, if only as the whole model."""
        if self.stop is not StopReason.UNREACHED or self.judged is None or self.asked_psnr is None:
            return self.stop.met
        return self.judged.psnr >= self.asked_psnr

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists, numbers and strings.

        Infinite numbers stay, which JSON lacks: `nanogs.formatting.plain` makes them text, as
        `--json` does.
        """
        return asdict(self)

    def __str__(self) -> str:
        """Return one line: the counts, the measured quality and cost if any, and the time."""
        counts = f"{self.input_count:,} -> {counted(self.achieved_count, 'splat')}"
        text = ", ".join([counts, *measures(self), time_text(self.total_seconds)])
        return text if self.stop.met else f"{text}. {stop_text(self)}"

    def __repr__(self) -> str:
        return f"SimplifyReport({self})"  # all fields fill a notebook's screen


def measures(report: SimplifyReport) -> list[str]:
    """Return a text for each measurement: quality, loss by packing, and cost of drawing."""
    texts = [measured.text for measured in (report.judged, report.packed) if measured]
    if report.cost is not None and report.original_cost is not None:
        share = report.cost.share_of(report.original_cost)
        texts.append(f"{share:.1%} of the splats a pixel ({report.cost.splats_a_pixel:.1f})")
    return texts


def stop_text(report: SimplifyReport) -> str:
    """Explain in one sentence why a result does not meet the request."""
    if report.stop == StopReason.UNREACHED:
        return f"{_nearest_text(report)}, so the whole model was written (stop: {report.stop})."
    if report.stop == StopReason.PROBES and report.asked_draw_cost is not None:
        return (
            f"The search for the most splats ended after {len(report.draw_probes)} counts; the"
            " result costs no more to draw than was asked, but a larger one might be possible"
            f" (stop: {report.stop})."
        )
    if report.stop == StopReason.PROBES:
        return (
            f"The search for the fewest splats ended after {len(report.probes)} counts; the result"
            f" reaches {report.asked_psnr:g} dB, but a smaller one might too (stop: {report.stop})."
        )
    return f"Stopped before the requested count was reached: {report.stop}."


def _nearest_text(report: SimplifyReport) -> str:
    """Return the PSNR of the largest count that was tried, beside that asked for, in words."""
    if not report.probes:
        return f"No fewer splats than {report.input_count:,} can be tried"
    most = max(report.probes, key=attrgetter("count"))
    share = f"{most.count:,} of {counted(report.input_count, 'splat')}"
    return f"{most.psnr:.2f} dB with {share} is less than {report.asked_psnr:g} dB"
