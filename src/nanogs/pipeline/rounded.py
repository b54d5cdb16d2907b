"""Rounding the fitted values of a result in memory so that its file packs well."""

from dataclasses import replace
from pathlib import Path

from nanogs.clock import StageClock
from nanogs.frames import back, turned
from nanogs.io import economical, registry
from nanogs.io.format import FormatOptions
from nanogs.pipeline.options.presets import Parameters
from nanogs.pipeline.options.target import rounds_for_file
from nanogs.pipeline.outcome import Outcome
from nanogs.progress import Tracker


def rounded(
    outcome: Outcome,
    path: Path,
    options: FormatOptions,
    frame: tuple[str, str] | None = None,
    coarseness: float = 1.0,
) -> Outcome:
    """Round the values of a result to those of a format, by how much they show.

    Args:
        outcome: The result, unchanged if it was not fitted.
        path: Its file; only the suffix counts.
        options: Options of the format.
        frame: Source and target frame that the result is turned from and to before it is written.
        coarseness: See `nanogs.io.economical`.
    """
    if outcome.curvatures is None:
        return outcome
    splats = turned(outcome.splats, frame)
    small = economical(splats, outcome.curvatures, path, options, coarseness)
    return replace(outcome, splats=turned(small, back(frame)), curvatures=None)


def rounded_for_file(
    outcome: Outcome,
    chosen: Parameters,
    path: Path,
    options: FormatOptions,
    frame: tuple[str, str] | None,
    clock: StageClock,
    progress: Tracker,
) -> Outcome:
    """Round the values of a result of a known count, if the format and the fit allow it.

    Args:
        outcome: The result.
        chosen: Parameters that it was made with.
        path: The file that it is going to be written to; only the suffix counts.
        options: Options of the format.
        frame: Source and target frame that it is turned from and to before it is written.
        clock: Gets the seconds of the stage "encode".
        progress: Notified of this stage.
    """
    if not rounds_for_file(chosen, registry.writable(path)):
        return outcome
    progress.begin("encode")
    with clock.time("encode"):
        return rounded(outcome, path, options, frame)
