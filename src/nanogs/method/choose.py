"""Choose by measurement: of several groupings, the one that looks most like the original."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from nanogs._types import I32
from nanogs.progress import Parts, untold
from nanogs.report import CandidateReport
from nanogs.splats import Splats

# Tried in turn after the usual one, as long as that helps clearly: thin opaque shells want more,
# where merged splats would let light through at grazing angles.
GROWTHS = (1.5, 1.8, 2.1)
GROWTH_MARGIN = 0.5  # dB that a growth has to gain: a few small views judge it roughly
SSIM_WORTH = 50.0  # dB of PSNR that a whole unit of SSIM is worth: 0.02 counts as one dB


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A grouping, the model it makes, also if it grows by so much, and how that did."""

    labels: I32
    grown: Callable[[float], Splats]
    model: Splats
    report: CandidateReport


def quality(psnr: float, ssim: float) -> float:
    """PSNR and SSIM in one number: PSNR alone would favour blur."""
    return psnr + SSIM_WORTH * ssim


def choose_model(
    regroup: Callable[[I32], I32],
    groups_at: Callable[[float], I32],
    store: Callable[[I32], Callable[[float], Splats]],
    judge: Callable[[Splats], tuple[float, float]],
    balances: Sequence[float],
    growth: float,
    tell: Parts = untold,
) -> tuple[Candidate, tuple[CandidateReport, ...]]:
    """Try cuts of several balances, the best one reassigned, the best of these grown more.

    No more than two models are held at a time.

    Args:
        regroup: Reassigns labels.
        groups_at: The labels of the cut of a balance.
        store: The model that labels make, if its opaque splats grow by so much at most.
        judge: Its PSNR and SSIM.
        balances: What to try, at least one; ties go to the first.
        growth: That of the first candidates.
        tell: Told of the candidates tried, and of how many there may be.

    Returns:
        The chosen one, and how every candidate did, the chosen one marked.
    """
    reports: list[CandidateReport] = []
    most = len(balances) + 1 + sum(more > growth for more in GROWTHS)

    def attempt(
        labels: I32,
        grown: Callable[[float], Splats],
        balance: float,
        growth: float,
        *,
        reassigned: bool,
    ) -> Candidate:
        model = grown(growth)
        psnr, ssim = judge(model)
        worth = quality(psnr, ssim)
        report = CandidateReport(balance, reassigned, growth, psnr, ssim, worth, chosen=False)
        reports.append(report)
        tell(len(reports), most)
        return Candidate(labels, grown, model, report)

    usual: Candidate | None = None
    for balance in balances:
        labels = groups_at(balance)
        usual = better(usual, attempt(labels, store(labels), balance, growth, reassigned=False))
    assert usual is not None  # noqa: S101 - at least one balance
    labels, balance = regroup(usual.labels), usual.report.balance
    usual = better(usual, attempt(labels, store(labels), balance, growth, reassigned=True))

    winner = usual
    for more in GROWTHS:
        if more > growth:
            report = winner.report
            further = attempt(
                winner.labels, winner.grown, report.balance, more, reassigned=report.reassigned
            )
            if further.report.quality <= report.quality + GROWTH_MARGIN:
                break
            winner = further
    marked = (replace(report, chosen=report is winner.report) for report in reports)
    return winner, tuple(marked)


def better(first: Candidate | None, second: Candidate) -> Candidate:
    """Pick the candidate of higher quality, the first of equal ones."""
    if first is None or second.report.quality > first.report.quality:
        return second
    return first
