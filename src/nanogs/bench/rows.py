"""The rows of a run: one for each scene, method and request, measured, skipped or failed."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple

from nanogs.formatting import plain

ORIGINAL = "original"


class BenchTarget(NamedTuple):
    """A request to every method: a compaction ratio, or a format and size of the result's file.

    Attributes:
        ratio: Compaction ratio in (0, 1]; None if a file size is requested.
        format: Suffix of the file, such as ".sog"; empty with a ratio, except for the whole model
            written in a format, which has the ratio 1.
        size: Maximum size of the file, bytes; None with a ratio.
    """

    ratio: float | None
    format: str = ""
    size: int | None = None

    @property
    def text(self) -> str:
        """The request as shown in tables: "0.1", "0.5MB .sog" or "whole .sog"."""
        if self.size is not None:
            return f"{size_name(self.size)} {self.format}"
        return f"whole {self.format}" if self.format else f"{self.ratio:g}"


RowKey = tuple[str, str, BenchTarget]


def size_name(size: int) -> str:
    """Format bytes as used in names of files, without rounding: 0.5MB."""
    return f"{size / 1e6:.6f}".rstrip("0").rstrip(".") + "MB"


class Status(StrEnum):
    """The outcome of a row."""

    OK = "ok"
    SKIPPED = "skipped"  # nothing to measure, for the stated reason
    FAILED = "failed"  # the method raised, or its process ended early


class Against(StrEnum):
    """The reference images that renders are compared with."""

    PHOTOGRAPHS = "photographs"
    ORIGINAL = "the original model"


@dataclass(frozen=True, slots=True)
class SetScore:
    """The score on one set of views.

    Attributes:
        label: Kind and size of the views: "roam 512"; empty for photographs.
        views: Number of views that were scored.
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
    """The result of one method on one scene for one request; missing values are None.

    Attributes:
        scene: Name of the scene.
        method: Name of the method; `ORIGINAL` for the original model.
        ratio: Compaction ratio requested; 1 for the original, None with a file size.
        status: Whether it was measured, skipped or failed.
        reason: Why it was skipped or failed, one sentence.
        against: The reference images of PSNR and SSIM.
        dataset: The published data set that the scene belongs to.
        splats: Splats delivered.
        file_bytes: Size of the result's file, which is a .ply for our methods at a ratio.
        seconds: The method alone on warm kernels, without reading and writing; with writing if a
            file size was requested; for an external file as noted by its producer, which may
            include both.
        read_seconds: Reading the model, in the method's process.
        peak_memory: Peak resident memory of the method's process, bytes, Python included.
        label: Kind and size of the views: "auto 512"; empty for photographs.
        psnr: Mean over the views, dB; infinite for equal images.
        least_psnr: PSNR of the worst view, dB.
        ssim: Mean over the views.
        extras: Means of further metrics by name.
        further: The scores on each further set of views.
        fps: Frames per second of our renderer, in sequence.
        fps_gsplat: Frames per second of gsplat on the GPU.
        views: Number of views that were scored.
        notes: Remarks that matter for reading the numbers.
        format: Suffix of the requested file; the file is decoded again before it is scored.
        size: Maximum size of the file, bytes.
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
    def target(self) -> BenchTarget:
        """The requested ratio or file size."""
        return BenchTarget(self.ratio, self.format, self.size)

    @property
    def key(self) -> RowKey:
        """Scene, method and request, unique within a run."""
        return self.scene, self.method, self.target

    @property
    def measured(self) -> bool:
        """Whether the row has a score."""
        return self.status is Status.OK and self.psnr is not None

    @property
    def sets(self) -> tuple[SetScore, ...]:
        """The scores on all sets of views, in order."""
        own = SetScore(self.label, self.views, self.psnr, self.least_psnr, self.ssim, self.extras)
        return (own, *self.further)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinities and NaN, which JSON lacks, are strings."""
        data: dict[str, Any] = plain(asdict(self))
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "BenchRow":
        """Rebuild a row from the output of `to_dict`."""
        values = _values(data)
        values["status"], values["against"] = Status(data["status"]), Against(data["against"])
        further = tuple(SetScore(**_values(one)) for one in data["further"])
        return cls(**values | {"notes": tuple(data["notes"]), "further": further})


_WORDS = {"scene", "method", "reason", "dataset", "label", "format"}


def _values(data: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value if name in _WORDS else _value(value) for name, value in data.items()}


def _value(value: Any) -> Any:  # noqa: ANN401 - whatever a row holds
    if isinstance(value, dict):
        return {name: _value(entry) for name, entry in value.items()}
    return float(value) if value in ("inf", "-inf", "nan") else value
