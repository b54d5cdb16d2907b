"""`nanogs compare --mixed`: refused options and output; streams are scored as viewers draw them."""

from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from nanogs.cli.console import out, say, show
from nanogs.errors import OptionError
from nanogs.formatting import NONE, counted, number_text

if TYPE_CHECKING:
    from nanogs.scoring.mixed import MixedComparison, MixedScore
    from nanogs.scoring.mixed_views import MixedView


def refuse_others(**given: object) -> None:
    """Refuse options that do not apply to --mixed.

    Args:
        given: Values of these options by name; empty values were not given.

    Raises:
        OptionError: One was given.
    """
    for name, value in given.items():
        if value:
            raise OptionError(
                f"--{name.replace('_', '-')} cannot be combined with --mixed; leave one of them"
                " out."
            )


def show_mixed(comparison: "MixedComparison") -> None:
    """Print the scores of each view, and the means of each stream."""
    for score in comparison.scores:
        table = Table("view", "chunks", box=None, pad_edge=False)
        for heading in ("splats", "PSNR", "SSIM", "coarse", "PSNR", "SSIM", "at seams", "worse by"):
            table.add_column(heading, justify="right")
        for view in score.views:
            table.add_row(Text(view.view), *_cells(view))
        show(out, table)
        say(_means(score))
    say(
        "chunks: number of chunks of each level, the finest first; coarse: the coarsest of these"
        " levels, alone; at seams: share of the pixels at which levels meet; worse by: loss in dB"
        " there against the coarser level alone"
    )


def _cells(view: "MixedView") -> tuple[str, ...]:
    return (
        " ".join(map(str, view.chunks)), f"{view.splats:,}", number_text(view.psnr),
        number_text(view.ssim, 4), NONE if view.coarse is None else f"level {view.coarse}",
        number_text(view.coarse_psnr), number_text(view.coarse_ssim, 4), f"{view.seams:.1%}",
        number_text(view.seam_loss),
    )  # fmt: skip


def _means(score: "MixedScore") -> str:
    chosen = (
        "by distance" if score.budget is None else f"of at most {counted(score.budget, 'splat')}"
    )
    mixed = f"{number_text(score.psnr)} dB / {number_text(score.ssim, 4)} on {score.protocol.text}"
    coarse = f"{number_text(score.coarse_psnr)} dB / {number_text(score.coarse_ssim, 4)}"
    seams = "no levels meet"
    if score.seam_loss is not None:
        than = "better" if score.seam_loss < 0 else "worse"
        share = f"{score.seams:.1%} of the pixels"
        seams = (
            f"seams, {share}, are {number_text(abs(score.seam_loss))} dB {than} than the coarser"
        )
    return f"{score.name}, levels {chosen}: {mixed}; the coarsest alone {coarse}; {seams}"
