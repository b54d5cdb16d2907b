"""Choose by measurement: of several groupings, the one that looks most like the original."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from nanogs._types import I32
from nanogs.report import CandidateReport
from nanogs.splats import Splats

BALANCES = (0.5, 0.8, 1.0)
SSIM_WORTH = 50.0  # dB of PSNR that a whole unit of SSIM is worth: 0.02 counts as one dB

Judge = Callable[[Splats], tuple[float, float]]


def quality(psnr: float, ssim: float) -> float:
    """What is compared: PSNR alone would favour blur."""
    return psnr + SSIM_WORTH * ssim


def choose_groups(
    regroup: Callable[[I32], I32],
    groups_at: Callable[[float], I32],
    store: Callable[[I32], Splats],
    judge: Judge,
    balances: Sequence[float],
) -> tuple[I32, tuple[CandidateReport, ...]]:
    """Try cuts of several balances, then the best one reassigned; keep the best of all.

    Args:
        regroup: Reassigns labels.
        groups_at: The labels of the cut of a balance.
        store: The model that labels make.
        judge: Its PSNR and SSIM.
        balances: What to try, at least one.

    Returns:
        The labels, and how every candidate did, the chosen one marked.
    """
    tried: list[tuple[I32, CandidateReport]] = []

    def attempt(labels: I32, balance: float, *, reassigned: bool) -> None:
        psnr, ssim = judge(store(labels))
        report = CandidateReport(balance, reassigned, psnr, ssim, quality(psnr, ssim), chosen=False)
        tried.append((labels, report))

    def best() -> int:
        return int(np.argmax([report.quality for _, report in tried]))  # ties to the first

    for balance in balances:
        attempt(groups_at(balance), balance, reassigned=False)
    labels, leader = tried[best()]
    attempt(regroup(labels), leader.balance, reassigned=True)
    winner = best()
    reports = [
        dataclasses.replace(report, chosen=place == winner)
        for place, (_, report) in enumerate(tried)
    ]
    return tried[winner][0], tuple(reports)
