"""Rate-distortion curves of files, and the gain of one method over another at equal file size."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from nanogs.bench.bjontegaard import Curve, bd_quality, bd_rate, rises
from nanogs.bench.means import unique
from nanogs.bench.rows import BenchRow, SetScore


@dataclass(frozen=True, slots=True)
class Gain:
    """The gain of a method over another at equal file size, on one scene (see `bjontegaard`).

    Attributes:
        scene: The scene.
        method: The method.
        anchor: The method compared with; several names for the best of them at each size.
        format: Suffix of the files.
        label: Kind and size of the views.
        psnr: Mean difference of PSNR at equal bytes, dB; None if it is undefined.
        ssim: The same for SSIM.
        rate: Relative increase in bytes at equal PSNR: -0.5 saves half of them.
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
        gains: The gain on each scene.
        psnr: Mean of the scenes' BD-PSNR, dB; None if no scene has one.
        least_psnr: The lowest BD-PSNR of any scene.
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
        """The gain on the first scene: its method, anchor, format and label are those of all."""
        return self.gains[0]


@dataclass(frozen=True, slots=True)
class _Curves:
    """The rate-distortion curves of a method on one scene: PSNR and SSIM over bytes."""

    psnr: Curve
    ssim: Curve


def mean_gains(rows: Sequence[BenchRow], others: Sequence[str] = ()) -> list[MeanGain]:
    """Compute mean gains over scenes, by format, views, anchor and method.

    Args:
        rows: From `run_bench`; only those with a file size are used.
        others: Anchors, the methods to compare with: each one, and if there are several also the
            best of them at each size. By default the first method.

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
    """Compute the gain of each method over each anchor, scene by scene.

    Args:
        rows: From `run_bench`; only those with a file size are used.
        others: As for `mean_gains`.

    Raises:
        OptionError: SciPy is not installed.
    """
    sized = [row for row in rows if row.size is not None]
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
    """Return the pairs of file format and label of a set of views that have scores."""
    return unique((row.format, one.label) for row in rows if row.measured for one in row.sets)


def _envelope(rows: Sequence[BenchRow], label: str) -> _Curves:
    """Return curves of the best file at each requested size, by PSNR and by SSIM separately."""
    psnrs: dict[int, tuple[float, float]] = {}  # bytes and PSNR by requested size
    ssims: dict[int, tuple[float, float]] = {}
    for row in rows:
        score = score_on(row, label)
        if score is None or row.size is None or not row.file_bytes:
            continue
        for best, quality in ((psnrs, score.psnr), (ssims, score.ssim)):
            point = row.file_bytes, quality or 0.0
            best[row.size] = max(best.get(row.size, point), point, key=itemgetter(1))
    return _Curves(_curve(psnrs.values()), _curve(ssims.values()))


def _curve(points: Iterable[tuple[float, float]]) -> Curve:
    """Return the best point for each number of bytes: two requests may give the same file."""
    qualities: dict[float, float] = {}
    for taken, quality in points:
        qualities[taken] = max(quality, qualities.get(taken, quality))
    return list(qualities.items())


def score_on(row: BenchRow, label: str) -> SetScore | None:
    """Return a row's score on the views of a label; None if it has none or its PSNR is infinite."""
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
    """Explain missing figures, which are means over the sizes or PSNRs that both curves cover."""
    missing = [name for name, figure in figures.items() if figure is None]
    if missing and min(len(anchor), len(test)) < 2:
        return ("no figures, because they need at least two sizes of each method",)
    reasons = {name: f"the curves share no {name}" for name in missing}
    if "PSNRs" in reasons and not (rises(anchor) and rises(test)):
        reasons["PSNRs"] = "no BD-rate, because a larger file has a lower PSNR"
    return tuple(reasons.values())
