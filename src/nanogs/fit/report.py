"""The report of a refit: frozen dataclasses that convert to JSON directly."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from nanogs.formatting import counted, time_text


class RefitStop(StrEnum):
    """The reason why a refit stopped."""

    ROUNDS = "rounds"  # all rounds were made
    OPTIMUM = "optimum"  # even a learning rate below a fifth of the first brought no improvement


@dataclass(frozen=True, slots=True)
class RoundReport:
    """One round of steps.

    Attributes:
        fitted: Groups of parameters that moved.
        steps: Number of steps.
        rate: Learning rate of the round.
        fit_psnr: PSNR on the views fitted to, dB: of the mean over the steps of the squared error
            of each step's view before the step.
        psnr_before: PSNR on the validation views before the round, dB, as in `RefitReport`.
        psnr_after: PSNR on the validation views after the part of the round that was kept, dB.
        share: The part of the round that was kept, from 0, the state before it, to 1, the state
            after it.
        seconds: Duration of the round, seconds.
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
    """The result on validation views of similar picture size and distance.

    Attributes:
        name: Size of the pictures in pixels, and "near" or "far" if distances differ much.
        views: Names of the cameras.
        psnr_before: Mean PSNR of the input over the views, dB, over black and white backgrounds; a
            view counts as 57 dB at most, the rounding to 8 bits.
        psnr_after: The same of the result; never below `psnr_before`.
        pixels: Length of the longer sides of these pictures: "512", or "512 to 900".
    """

    name: str
    views: tuple[str, ...]
    psnr_before: float
    psnr_after: float
    pixels: str = ""


@dataclass(frozen=True, slots=True)
class RefitReport:
    """The report of `refit`: its input, the improvement, and why it stopped.

    Attributes:
        parameters: Every parameter by name.
        original_count: Number of splats in the original.
        count: Number of splats in the small model, before and after.
        fit_views: Names of the cameras fitted to.
        validation_views: Names of the cameras of the validation views.
        groups: The improvement on each group of the validation views.
        psnr_before: PSNR of the input on the validation views, mean over the groups, dB; a view
            counts as 57 dB at most, the rounding to 8 bits. If the file will have a palette, the
            input's splats share harmonics already.
        psnr_after: PSNR of the result on these views, dB; never below `psnr_before`.
        improved: False if nothing was changed.
        rounds: The rounds in order.
        stop: The reason why it stopped.
        seconds: Time by stage, seconds.
        total_seconds: Time of the whole call, seconds.
        threads: Number of threads used.
        notes: Further remarks for the user, one sentence each.
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
        """The PSNR before and after, and the reason why it stopped, as one clause."""
        before, after = self.psnr_before, self.psnr_after
        return f"{before:.2f} to {after:.2f} dB on the validation views, stopped by: {self.stop}"

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain dictionaries, lists, numbers and strings."""
        return asdict(self)

    def __str__(self) -> str:
        """Return one line: the counts, the improvement, why it stopped, and the time."""
        counts = f"{counted(self.count, 'splat')} fitted to {self.original_count:,}"
        return f"{counts}, {self.text}, {time_text(self.total_seconds)}"

    def __repr__(self) -> str:
        return f"RefitReport({self})"  # all fields fill a notebook's screen
