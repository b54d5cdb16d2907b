"""Rate-distortion curves of files, and what methods gain on each other at equal size."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nanogs.bench.bjontegaard import Curve, bd_quality, bd_rate, rises
from nanogs.bench.means import unique
from nanogs.bench.rows import ORIGINAL, BenchRow, SetScore


@dataclass(frozen=True, slots=True)
class Gain:
    """Gain of a method on another at equal size, on one scene (see `bjontegaard`).

    Attributes:
        scene: The scene.
        method: The method.
        anchor: The other; several names for the best of them at each size.
        format: Suffix of the files.
        label: Kind and size of the views.
        psnr: Mean difference of PSNR at equal bytes, dB; None where there is none.
        ssim: The same of SSIM.
        rate: Share of the bytes that it takes more at equal PSNR: -0.5 saves half of them.
        remarks: Why a number is missing.
    """

    scene: str
    method: str
    anchor: str
    format: str
    label: str
    psnr: float | None
    ssim: float | None
    rate: float | None
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class MeanGain:
    """The means of gains over the scenes that have a number.

    Attributes:
        gains: Of each scene.
        psnr: Mean of the scenes' BD-PSNR, dB; None where no scene has one.
        least_psnr: The least of them.
        ssim: Mean of their BD-SSIM.
        rate: Mean of their BD-rate.
    """

    gains: tuple[Gain, ...]
    psnr: float | None
    least_psnr: float | None
    ssim: float | None
    rate: float | None

    @property
    def first(self) -> Gain:
        """One of them, which has the names that all share."""
        return self.gains[0]


@dataclass(frozen=True, slots=True)
class _Curves:
    """A method's points on one scene: bytes, and each quality."""

    psnr: Curve
    ssim: Curve


def mean_gains(rows: Sequence[BenchRow], others: Sequence[str] = ()) -> list[MeanGain]:
    """Means over scenes, by format, views, what is gained on, and method.

    Args:
        rows: From `run_bench`; those of a size count.
        others: Methods to be held against: each, and the best of them at each size where there are
            several. By default the first method.

    Raises:
        OptionError: SciPy is not installed.
    """
    found: dict[tuple[str, ...], list[Gain]] = {}
    for gain in gains(rows, others):
        key = (gain.format, gain.label, gain.anchor, gain.method)
        found.setdefault(key, []).append(gain)
    return [_mean(each) for each in found.values()]


def _mean(each: Sequence[Gain]) -> MeanGain:
    psnr = [gain.psnr for gain in each if gain.psnr is not None]
    ssim = [gain.ssim for gain in each if gain.ssim is not None]
    rate = [gain.rate for gain in each if gain.rate is not None]
    least = min(psnr, default=None)
    return MeanGain(tuple(each), _average(psnr), least, _average(ssim), _average(rate))


def _average(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def gains(rows: Sequence[BenchRow], others: Sequence[str] = ()) -> list[Gain]:
    """Gains of every method on every other one that it is held against, scene by scene.

    Args:
        rows: From `run_bench`; those of a size count.
        others: As for `mean_gains`.

    Raises:
        OptionError: SciPy is not installed.
    """
    sized = [row for row in rows if row.size is not None and row.method != ORIGINAL]
    methods = unique(row.method for row in sized)
    anchors = list(others) or methods[:1]
    made = []
    for suffix, label in views_of(sized):
        for names in [*([name] for name in anchors), *([anchors] if len(anchors) > 1 else [])]:
            anchor = ", ".join(names)
            for method in (name for name in methods if name not in anchors):
                for scene in unique(row.scene for row in sized):
                    here = [row for row in sized if (row.scene, row.format) == (scene, suffix)]
                    one = _envelope([row for row in here if row.method in names], label)
                    two = _envelope([row for row in here if row.method == method], label)
                    if one.psnr or two.psnr:
                        made.append(_gain((scene, method, anchor, suffix, label), one, two))
    return made


def views_of(rows: Sequence[BenchRow]) -> list[tuple[str, str]]:
    """Formats of files, and labels of the sets of views that are scored with each."""
    return unique((row.format, one.label) for row in rows if row.measured for one in row.sets)


def _envelope(rows: Sequence[BenchRow], label: str) -> _Curves:
    """The best file at each size that was asked for: the highest PSNR, and the highest SSIM."""
    best: dict[int, tuple[tuple[float, float], tuple[float, float]]] = {}
    for row in rows:
        score = score_on(row, label)
        if score is None or row.size is None or not row.file_bytes:
            continue
        psnr, ssim = (row.file_bytes, score.psnr or 0.0), (row.file_bytes, score.ssim or 0.0)
        known = best.get(row.size, (psnr, ssim))
        best[row.size] = (_higher(known[0], psnr), _higher(known[1], ssim))
    return _Curves([psnr for psnr, _ in best.values()], [ssim for _, ssim in best.values()])


def _higher(one: tuple[float, float], two: tuple[float, float]) -> tuple[float, float]:
    return two if two[1] > one[1] else one


def score_on(row: BenchRow, label: str) -> SetScore | None:
    """A row's score on the views of a label; None where it has none, or an infinite one."""
    scores = (one for one in row.sets if row.measured and one.label == label)
    score = next(scores, None)
    if score is None or score.psnr is None or not math.isfinite(score.psnr):
        return None
    return score


def _gain(names: tuple[str, str, str, str, str], anchor: _Curves, test: _Curves) -> Gain:
    psnr, ssim = bd_quality(anchor.psnr, test.psnr), bd_quality(anchor.ssim, test.ssim)
    rate = bd_rate(anchor.psnr, test.psnr)
    remarks = _remarks(anchor.psnr, test.psnr, {"sizes": psnr, "PSNRs": rate})
    return Gain(*names, psnr, ssim, rate, remarks)


def _remarks(anchor: Curve, test: Curve, figures: Mapping[str, float | None]) -> tuple[str, ...]:
    """Why figures are missing, which are means over the sizes or PSNRs that curves share."""
    missing = [name for name, figure in figures.items() if figure is None]
    if missing and min(len(anchor), len(test)) < 2:
        return ("no figure: it takes two sizes of each",)
    if missing == ["PSNRs"] and not (rises(anchor) and rises(test)):
        return ("no BD-rate: a larger file has the lower PSNR",)
    return tuple(f"the curves share no {name}" for name in missing)
