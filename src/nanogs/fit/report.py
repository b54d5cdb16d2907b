"""The report of a refit: frozen dataclasses that become JSON as they stand."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class RefitStop(StrEnum):
    """Why the rounds ended."""

    ROUNDS = "rounds"  # all of them were made
    OPTIMUM = "optimum"  # steps of less than a fifth of the first length did not help either


@dataclass(frozen=True, slots=True)
class RoundReport:
    """One round of steps.

    Attributes:
        fitted: Groups of parameters that moved.
        steps: Steps made.
        rate: Length of its first step.
        fit_psnr: Of the mean of the squared errors before each step, of the step's own view, dB.
        psnr_before: On the validation views before it, dB, as in `RefitReport`.
        psnr_after: On the validation views after what was kept of it, dB.
        share: How much of its way was kept, from the state before it (0) to that after it (1).
        seconds: The round, seconds.
    """

    fitted: tuple[str, ...]
    steps: int
    rate: float
    fit_psnr: float
    psnr_before: float
    psnr_after: float
    share: float
    seconds: float


@dataclass(frozen=True, slots=True)
class GroupReport:
    """Validation views of about one picture size and distance.

    Attributes:
        name: Size of the pictures in pixels, and near or far where distances differ much.
        views: Names of the cameras.
        psnr_before: Mean of the input over them, dB, over black and white alike.
        psnr_after: The same of the result; never below `psnr_before`.
        pixels: Along the longer sides of these pictures: "512", or "512 to 900".
    """

    name: str
    views: tuple[str, ...]
    psnr_before: float
    psnr_after: float
    pixels: str = ""


@dataclass(frozen=True, slots=True)
class RefitReport:
    """The report of `refit`: what it was given, what it gained, and why it stopped.

    Attributes:
        parameters: Every parameter by name.
        original_count: Splats in the original.
        count: Splats in the small model, before and after.
        fit_views: Names of the cameras fitted to.
        validation_views: Names of the cameras that decided.
        groups: What was gained on each group of the validation views.
        psnr_before: What the fit begins with on the validation views, mean over the groups, dB: the
            input, whose splats share harmonics already where the file will have a palette.
        psnr_after: The result on them, dB; never below `psnr_before`.
        improved: False where nothing was moved.
        rounds: The rounds in order.
        stop: Why it stopped.
        seconds: Time by stage, seconds.
        total_seconds: The whole call, seconds.
        threads: Threads used.
        notes: What else the user should know, one sentence each.
    """

    parameters: dict[str, float | int]
    original_count: int
    count: int
    fit_views: tuple[str, ...]
    validation_views: tuple[str, ...]
    groups: tuple[GroupReport, ...]
    psnr_before: float
    psnr_after: float
    improved: bool
    rounds: tuple[RoundReport, ...]
    stop: RefitStop
    seconds: dict[str, float]
    total_seconds: float
    threads: int
    notes: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Say what was gained, and why it ended."""
        before, after = self.psnr_before, self.psnr_after
        return f"{before:.2f} to {after:.2f} dB on the views that decide, stopped by: {self.stop}"

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and strings."""
        return asdict(self)
