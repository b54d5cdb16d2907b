"""Our means in the layout of the published table, beside the published figures."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from nanogs.bench.means import mean_rows, unique
from nanogs.bench.published import CITATION, DATASETS, RATIOS, Figures, PublishedDataset
from nanogs.bench.rows import ORIGINAL, Against, BenchRow
from nanogs.formatting import NONE


def published_tables(rows: Sequence[BenchRow]) -> Iterator[tuple[str, str]]:
    """Yield a title and Markdown; nothing if no scene of a published data set was measured.

    Args:
        rows: From `run_bench`.
    """
    rows = [row for row in rows if row.dataset and row.against is Against.PHOTOGRAPHS]
    if rows and not any(row.format for row in rows):
        yield "Published protocol, against photographs", published_table(rows)


def published_table(rows: Sequence[BenchRow]) -> str:
    """Return Markdown with a line for each data set and a column for each method, ours first.

    Args:
        rows: Rows of scenes of published data sets, against photographs.
    """
    ours = unique(row.method for row in rows if row.method != ORIGINAL)
    theirs = unique(name for entry in DATASETS.values() for name in entry.methods)
    head = ["data set", "3DGS here", "3DGS published", *(f"{name} here" for name in ours)]
    head += [f"{name} published" for name in theirs]
    lines = [_line(head), "|---" * len(head) + "|\n"]
    notes: list[str] = []
    for name in unique(row.dataset for row in rows if row.dataset):
        group = [row for row in rows if row.dataset == name]
        figures, remarks = our_figures(group)
        lines.append(_line(_cells(DATASETS[name], figures, ours, theirs, group)))
        notes += [f"- {DATASETS[name].title}: {remark}\n" for remark in remarks]
    legend = (
        f"\nPSNR / SSIM / LPIPS / seconds at ratio {RATIOS[0]:g}; then PSNR at {RATIOS[1]:g} and "
        f"{RATIOS[2]:g}. Of 3DGS itself: PSNR / SSIM / LPIPS. Published figures: {CITATION}; their "
        "seconds are of other machines.\n"
    )
    return "".join(lines) + legend + ("\n" + "".join(notes) if notes else "")


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |\n"


def _cells(
    dataset: PublishedDataset,
    figures: dict[str, Figures],
    ours: Sequence[str],
    theirs: Sequence[str],
    rows: Sequence[BenchRow],
) -> list[str]:
    scenes = len(unique(row.scene for row in rows))
    whole = "" if scenes == dataset.scenes else f", {scenes} of {dataset.scenes} scenes"
    return [
        dataset.title + whole,
        _original_cell(figures.get(ORIGINAL)),
        _original_cell(dataset.original),
        *(figures_cell(figures.get(name)) for name in ours),
        *(figures_cell(dataset.methods.get(name)) for name in theirs),
    ]


def our_figures(rows: Sequence[BenchRow]) -> tuple[dict[str, Figures], list[str]]:
    """Return our means on one data set by method, and remarks on scenes left out of them.

    Args:
        rows: Rows of one data set.
    """
    psnr: dict[str, dict[float, float]] = {}
    first: dict[str, BenchRow] = {}
    remarks = []
    for mean in mean_rows(rows):
        assert mean.target.ratio is not None  # noqa: S101 - the caller excludes file sizes
        if mean.left_out:
            remarks.append(f"at {mean.target.text} without {', '.join(mean.left_out)}")
        for name, row in mean.methods.items():
            psnr.setdefault(name, {})[mean.target.ratio] = row.psnr or 0.0
            if mean.target.ratio == RATIOS[0]:
                first[name] = row
    figures = {name: _figures(psnr[name], first.get(name)) for name in psnr}
    originals = [row for row in rows if row.method == ORIGINAL]
    if originals and all(row.measured for row in originals):
        whole = mean_rows([_renamed(row) for row in originals])[0].methods["model"]
        figures[ORIGINAL] = _figures({1.0: whole.psnr or 0.0}, whole)
    return figures, remarks


def _renamed(row: BenchRow) -> BenchRow:
    return replace(row, method="model")


def _figures(psnr: dict[float, float], row: BenchRow | None) -> Figures:
    if row is None:
        return Figures(psnr)
    return Figures(psnr, row.ssim, row.extras.get("lpips"), row.seconds)


def figures_cell(figures: Figures | None) -> str:
    """Format figures like the published table: 25.81 / .910 / .092 / 11 s; 22.28; 19.04."""
    if figures is None:
        return NONE
    first = [_psnr(figures, RATIOS[0]), _share(figures.ssim), _share(figures.lpips)]
    first.append(NONE if figures.seconds is None else f"{figures.seconds:.3g} s")
    while len(first) > 1 and first[-1] == NONE:
        first.pop()
    return "; ".join([" / ".join(first), *(_psnr(figures, ratio) for ratio in RATIOS[1:])])


def _original_cell(figures: Figures | None) -> str:
    if figures is None:
        return NONE
    return " / ".join((_psnr(figures, 1.0), _share(figures.ssim), _share(figures.lpips)))


def _psnr(figures: Figures, ratio: float) -> str:
    value = figures.psnr.get(ratio)
    return NONE if value is None else f"{value:.2f}"


def _share(value: float | None) -> str:
    return NONE if value is None else f"{value:.3f}".removeprefix("0")
