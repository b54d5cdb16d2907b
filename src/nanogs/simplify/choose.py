"""Choose by measurement: of several groupings, the one that looks most like the original."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from nanogs._types import I32
from nanogs.report import CandidateReport
from nanogs.splats import Splats

BALANCES = (0.5, 0.8, 1.0)
GROWTHS = (1.0, 1.3)  # no growth for what has no holes, much for thin opaque shells
GROWTH_MARGIN = 0.5  # dB: a few small views judge growth roughly, so the usual one stays in doubt
SSIM_WORTH = 50.0  # dB of PSNR that a whole unit of SSIM is worth: 0.02 counts as one dB

Judge = Callable[[Splats], tuple[float, float]]


def quality(psnr: float, ssim: float) -> float:
    """What is compared: PSNR alone would favour blur."""
    return psnr + SSIM_WORTH * ssim


def choose_groups(
    regroup: Callable[[I32], I32],
    groups_at: Callable[[float], I32],
    store: Callable[[I32, float], Splats],
    judge: Judge,
    balances: Sequence[float],
    growths: Sequence[float],
) -> tuple[I32, float, tuple[CandidateReport, ...]]:
    """Try cuts of several balances, the best one reassigned, the best of these grown otherwise.

    Args:
        regroup: Reassigns labels.
        groups_at: The labels of the cut of a balance.
        store: The model that labels make, its opaque splats grown by so much at most.
        judge: Its PSNR and SSIM.
        balances: What to try, at least one.
        growths: What to try, at least one; the first is that of the first candidates.

    Returns:
        The labels, the growth, and how every candidate did, the chosen one marked.
    """
    tried: list[tuple[I32, CandidateReport]] = []

    def attempt(labels: I32, balance: float, growth: float, *, reassigned: bool) -> None:
        psnr, ssim = judge(store(labels, growth))
        report = CandidateReport(
            balance, reassigned, growth, psnr, ssim, quality(psnr, ssim), chosen=False
        )
        tried.append((labels, report))

    def best() -> int:
        return int(np.argmax([report.quality for _, report in tried]))  # ties to the first

    for balance in balances:
        attempt(groups_at(balance), balance, growths[0], reassigned=False)
    labels, leader = tried[best()]
    attempt(regroup(labels), leader.balance, growths[0], reassigned=True)
    usual = best()
    labels, leader = tried[usual]
    for growth in growths[1:]:
        attempt(labels, leader.balance, growth, reassigned=leader.reassigned)
    clearly = tried[best()][1].quality > leader.quality + GROWTH_MARGIN
    winner = best() if clearly else usual
    reports = [
        dataclasses.replace(report, chosen=place == winner)
        for place, (_, report) in enumerate(tried)
    ]
    return tried[winner][0], reports[winner].growth, tuple(reports)
