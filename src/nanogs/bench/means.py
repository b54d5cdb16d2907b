"""Means over the scenes on which every compared method has a result."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from nanogs.bench.rows import ORIGINAL, BenchRow, BenchTarget, SetScore

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class TargetMean:
    """Means of one requested ratio or file size.

    Attributes:
        target: The request, the same for every method.
        scenes: Scenes that the means are taken over.
        left_out: Scenes that are left out, each with the methods that have no result there.
        absent: Methods without a result on any scene, which are not compared.
        methods: One row of means for each method.
    """

    target: BenchTarget
    scenes: tuple[str, ...]
    left_out: Mapping[str, tuple[str, ...]]
    absent: tuple[str, ...]
    methods: Mapping[str, BenchRow]


def mean_rows(rows: Sequence[BenchRow]) -> list[TargetMean]:
    """Compute the means for each request, in the order of the rows, without the original models.

    Args:
        rows: Rows scored against the same kind of images.
    """
    compared = [row for row in rows if row.method != ORIGINAL]
    return [
        _mean_at(target, [row for row in compared if row.target == target])
        for target in unique(row.target for row in compared)
    ]


def _mean_at(target: BenchTarget, rows: Sequence[BenchRow]) -> TargetMean:
    measured = {(row.scene, row.method): row for row in rows if row.measured}
    present = {method for _, method in measured}
    methods = unique(row.method for row in rows)
    compared = [method for method in methods if method in present]
    missing = {
        scene: tuple(method for method in compared if (scene, method) not in measured)
        for scene in unique(row.scene for row in rows)
    }
    scenes = tuple(scene for scene, without in missing.items() if not without and compared)
    return TargetMean(
        target=target,
        scenes=scenes,
        left_out={scene: without for scene, without in missing.items() if scene not in scenes},
        absent=tuple(method for method in methods if method not in present),
        methods={
            method: _mean_row([measured[scene, method] for scene in scenes])
            for method in compared
            if scenes
        },
    )


def _mean_row(rows: Sequence[BenchRow]) -> BenchRow:
    by_label = [{one.label: one for one in row.sets} for row in rows]
    shared = [label for label in by_label[0] if all(label in scores for scores in by_label)]
    own, *further = (_mean_score([scores[label] for scores in by_label]) for label in shared)
    return BenchRow(
        scene=f"mean of {len(rows)}",
        method=rows[0].method,
        ratio=rows[0].ratio,
        against=rows[0].against,
        dataset=rows[0].dataset,
        splats=_rounded(_mean([row.splats for row in rows])),
        file_bytes=_rounded(_mean([row.file_bytes for row in rows])),
        seconds=_mean([row.seconds for row in rows]),
        read_seconds=_mean([row.read_seconds for row in rows]),
        peak_memory=_rounded(_mean([row.peak_memory for row in rows])),
        label=rows[0].label,
        psnr=own.psnr,
        least_psnr=own.least_psnr,
        ssim=own.ssim,
        extras=own.extras,
        further=tuple(further),
        fps=_mean([row.fps for row in rows]),
        fps_gsplat=_mean([row.fps_gsplat for row in rows]),
        views=own.views,
        format=rows[0].format,
        size=rows[0].size,
    )


def _mean_score(scores: Sequence[SetScore]) -> SetScore:
    """Average scores on sets of one label; `least_psnr` is the mean of the worst views' PSNR."""
    extras = [name for name in scores[0].extras if all(name in one.extras for one in scores)]
    return SetScore(
        label=scores[0].label,
        views=sum(one.views or 0 for one in scores),
        psnr=_mean([one.psnr for one in scores]),
        least_psnr=_mean([one.least_psnr for one in scores]),
        ssim=_mean([one.ssim for one in scores]),
        extras={name: float(np.mean([one.extras[name] for one in scores])) for name in extras},
    )


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the mean, or None if a value is missing: the rest would average other scenes."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def _rounded(value: float | None) -> int | None:
    return None if value is None else round(value)


def unique(values: Iterable[Value]) -> list[Value]:
    """Return the distinct values in the order of their first occurrence."""
    return list(dict.fromkeys(values))
