"""One row for each scene, method and wish, whatever became of it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

from nanogs.formatting import plain

ORIGINAL = "original"


class Wish(NamedTuple):
    """A result that is asked of every method: a ratio, or a file of a format and a size.

    Attributes:
        ratio: Compaction ratio in (0, 1]; None where a file of a size is asked for.
        format: Suffix of the file, such as ".sog"; empty with a ratio, but for the whole model
            written in a format, which has the ratio 1.
        size: Bytes that the file may have.
    """

    ratio: float | None
    format: str = ""
    size: int | None = None

    @property
    def text(self) -> str:
        """As tables have it: "0.1", "0.5MB .sog" or "whole .sog"."""
        if self.size is not None:
            return f"{size_name(self.size)} {self.format}"
        return f"whole {self.format}" if self.format else f"{self.ratio:g}"


RowKey = tuple[str, str, Wish]


def size_name(size: int) -> str:
    """Bytes as names of files have them, exactly: 0.5MB."""
    return f"{size / 1e6:.6f}".rstrip("0").rstrip(".") + "MB"


class Status(StrEnum):
    """The state of a row."""

    OK = "ok"
    SKIPPED = "skipped"  # nothing to measure, for the stated reason
    FAILED = "failed"  # the method raised, or its process ended early


class Against(StrEnum):
    """The reference of the images."""

    PHOTOGRAPHS = "photographs"
    ORIGINAL = "the original model"


@dataclass(frozen=True, slots=True)
class SetScore:
    """The score on one set of views.

    Attributes:
        label: Kind and size of the views: "roam 512"; empty for photographs.
        views: Views that were scored.
        psnr: Mean over the views, dB; infinite for equal images.
        least_psnr: PSNR of the worst view, dB.
        ssim: Mean over the views.
        extras: Means of further metrics by name.
    """

    label: str = ""
    views: int | None = None
    psnr: float | None = None
    least_psnr: float | None = None
    ssim: float | None = None
    extras: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class BenchRow:
    """The result of one method on one scene for one wish; None where there is none.

    Attributes:
        scene: Name of the scene.
        method: Name of the method; `ORIGINAL` for the model as it came.
        ratio: Compaction ratio asked for; 1 for the original, None for files of a size.
        status: What became of it.
        reason: Why it was skipped or failed, one sentence.
        against: What PSNR and SSIM are measured against.
        dataset: The published data set that the scene belongs to.
        splats: Splats delivered.
        file_bytes: Size of the result: as .ply for what ran here at a ratio, else of the file.
        seconds: The method alone on warm kernels, without reading and writing; with writing where a
            file of a size was asked for; for an external file what its producer noted, which may
            hold both.
        read_seconds: Reading the model, in the method's process.
        peak_memory: Most resident memory of the method's process, bytes, Python included.
        label: Kind and size of the views: "auto 512"; empty for photographs.
        psnr: Mean over the views, dB; infinite for equal images.
        least_psnr: PSNR of the worst view, dB.
        ssim: Mean over the views.
        extras: Means of further metrics by name.
        further: The same on each further set of views.
        fps: Frames a second of our renderer, one after the other.
        fps_gsplat: Frames a second of gsplat on the GPU.
        views: Views that were scored.
        notes: What the reader of the numbers should know.
        format: Suffix of the file that was asked for; what is scored is the file as decoded.
        size: Bytes that the file may have.
    """

    scene: str
    method: str
    ratio: float | None
    status: Status = Status.OK
    reason: str = ""
    against: Against = Against.ORIGINAL
    dataset: str | None = None
    splats: int | None = None
    file_bytes: int | None = None
    seconds: float | None = None
    read_seconds: float | None = None
    peak_memory: int | None = None
    label: str = ""
    psnr: float | None = None
    least_psnr: float | None = None
    ssim: float | None = None
    extras: dict[str, float] = field(default_factory=dict)
    further: tuple[SetScore, ...] = ()
    fps: float | None = None
    fps_gsplat: float | None = None
    views: int | None = None
    notes: tuple[str, ...] = ()
    format: str = ""
    size: int | None = None

    @property
    def wish(self) -> Wish:
        """The size or ratio that was asked for."""
        return Wish(self.ratio, self.format, self.size)

    @property
    def key(self) -> RowKey:
        """Scene, method and wish, which no other row of a run has."""
        return self.scene, self.method, self.wish

    @property
    def measured(self) -> bool:
        """The row has a score."""
        return self.status is Status.OK and self.psnr is not None

    @property
    def sets(self) -> tuple[SetScore, ...]:
        """The scores on each set of views, the row's own first."""
        own = SetScore(self.label, self.views, self.psnr, self.least_psnr, self.ssim, self.extras)
        return (own, *self.further)

    def to_dict(self) -> dict[str, Any]:
        """Plain values; infinities and NaN, which JSON lacks, as strings."""
        data: dict[str, Any] = plain(asdict(self))
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "BenchRow":
        """The row that `to_dict` gave."""
        values = {name: value if name in _WORDS else _value(value) for name, value in data.items()}
        values["status"], values["against"] = Status(data["status"]), Against(data["against"])
        further = tuple(
            SetScore(
                **{name: value if name in _WORDS else _value(value) for name, value in one.items()}
            )
            for one in data["further"]
        )
        return cls(**values | {"notes": tuple(data["notes"]), "further": further})


_WORDS = {"scene", "method", "reason", "dataset", "label", "format"}


def _value(value: Any) -> Any:  # noqa: ANN401 - whatever a row holds
    if isinstance(value, dict):
        return {name: _value(entry) for name, entry in value.items()}
    return float(value) if value in ("inf", "-inf", "nan") else value
