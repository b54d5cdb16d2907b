"""`nanogs.mode_evidence`: evidence for a model's render mode, `default` or `mip`.

The rasteriser dilates 2D covariances by 0.3 pixels². With antialiasing (Yu et al., "Mip-Splatting",
2024) it also multiplies opacities by the square root of the ratio of determinants before and after
the dilation, and training adapts to that. A model trained without antialiasing relies on the
dilation: many of its splats are thinner than that.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from nanogs.bar import show_progress
from nanogs.costs import DrawCost
from nanogs.formatting import number_text
from nanogs.io.models import Model, opened
from nanogs.progress import PartProgress, Progress, Stage, Tracker
from nanogs.protocol import BLACK, PIXELS, VIEWS, Background, Protocol, plain_background
from nanogs.quantities import as_bytes
from nanogs.raster.camera import camera_notes
from nanogs.scoring.view_sets import Photographs, refuse_beside_photos, refuse_beside_views
from nanogs.source import Source, Tagged, source_of
from nanogs.splats import RenderMode, Splats
from nanogs.views.cameras import Cameras, chosen_cameras, known_cameras, picture_size
from nanogs.views.costing import pictures_of, protocol_of
from nanogs.views.plan import budget_for_pictures, rendering_remedy

if TYPE_CHECKING:
    from nanogs._types import F32, F64
    from nanogs.raster.camera import Camera
    from nanogs.scoring.scores import ReferenceView

MODES = RenderMode.DEFAULT, RenderMode.MIP
FADED = 0.1  # a splat is faded if antialiasing keeps less than this share of its opacity
OPAQUE = 0.99  # alpha from which a pixel is opaque
# Thresholds of evidence: three shares, and dB between PSNRs against photographs.
MANY_FADED, FEW_THIN, LEAKING, CLEAR = 0.05, 0.2, 0.01, 0.1


@dataclass(frozen=True, slots=True)
class ModeEvidence:
    """Evidence, from renders of a model, of the rasteriser it was trained for; not a proof.

    Attributes:
        thin: Share of the visible splats whose thinnest axis, on screen at their depth, is less
            than the standard deviation of the dilation, 0.55 pixels; over all views, in [0, 1].
        faded: Share of the visible splats to which antialiasing leaves less than a tenth of their
            opacity, in [0, 1].
        leak: Mean transmittance in `mip` of the pixels that are opaque in `default`, in [0, 1];
            None if there are no such pixels.
        between: Mean PSNR, dB, of the renders in `mip` against those in `default`: how much the
            mode matters; infinite if they are equal.
        photographs: PSNR against photographs by name of the render mode, dB; empty without
            photographs.
        protocol: The views.
    """

    thin: float
    faded: float
    leak: float | None
    between: float
    photographs: dict[str, float]
    protocol: Protocol

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for each number, the strongest evidence first."""
        lines = []
        if self.photographs:
            plain, fine = (self.photographs[mode] for mode in MODES)
            better = "" if abs(plain - fine) < CLEAR else MODES[plain < fine].value
            values = f"{number_text(plain)} dB as default and {number_text(fine)} dB as mip"
            lines.append(f"{values} on {self.protocol.text}, {_verdict(better)}")
        many = "default" if self.faded >= MANY_FADED else ""
        few = "mip, or for training at more pixels" if self.thin <= FEW_THIN else ""
        fade = f"{self.faded:.1%} of the splats in sight would lose nine tenths of their opacity"
        lines.append(f"{fade} as mip, {_verdict(many)}")
        lines.append(
            f"{self.thin:.0%} of them are thinner than the width to which default blurs them,"
            f" {_verdict(few)}"
        )
        if self.leak is not None:
            leaks = "default" if self.leak >= LEAKING else ""
            lines.append(
                f"{self.leak:.2%} of the light passes through opaque places as mip,"
                f" {_verdict(leaks)}"
            )
        return tuple(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists, numbers and strings."""
        return asdict(self) | {"sentences": list(self.sentences)}


def _verdict(mode: str) -> str:
    return f"which speaks for {mode}" if mode else "which says little"


def mode_evidence(
    model: Model,
    cameras: Cameras = "auto",
    *,
    photos: str | PathLike[str] | None = None,
    images: str | None = None,
    split: str = "test",
    background: Iterable[float] | None = None,
    views: int = VIEWS,
    pixels: int | tuple[int, int] = PIXELS,
    up: Sequence[float] | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
) -> ModeEvidence:
    """Render a model in both render modes, and return evidence for either; its own is ignored.

    Photographs decide, if there are any. Without them the evidence is weak; it is strongest on
    views of the same number of pixels as the training views.

    Args:
        model: The model, or a path.
        cameras: As for `render`.
        photos: Folder of a NeRF-Synthetic, nerfstudio or COLMAP data set, to compare with its
            photographs. Excludes the arguments of views.
        images: Folder of the photographs in a COLMAP data set.
        split: Photographs to use, "test" or "train".
        background: RGB in [0, 1] behind the splats; by default black, and for photographs the data
            set's own.
        views: Number of automatic views.
        pixels: Size of automatic views: one number for width and height, or both.
        up: (3,) up direction of automatic views; found from the model by default.
        threads: Threads to use; all by default. The result does not depend on it.
        max_memory: Bytes that this process may take, a number or a text such as "4GB"; by default
            the free memory, less a tenth. A model that does not fit is read some rows at a time.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`.

    Raises:
        FormatError: The model, the cameras or the photographs cannot be read.
        ModelError: Nothing of the model is visible, so that no views are found.
        NotEnoughMemoryError: It takes more memory than is free or allowed, even row by row.
        OptionError: An argument is out of range.
    """
    refuse_beside_views(photos, images, split)
    seen: ModelViews | Photographs = ModelViews(cameras, views, pixels, up)
    if photos is not None:
        usual = views == VIEWS and picture_size(pixels) == (PIXELS, PIXELS)
        refuse_beside_photos(photos, views=not usual or cameras != "auto" or up is not None)
        seen = Photographs(Path(photos), images, split)
    return render_findings(
        model, seen, background=background, threads=threads, max_memory=max_memory,
        progress=progress, costs=False,
    ).modes  # fmt: skip


class ModelViews(NamedTuple):
    """Views of a model that are asked for, as `nanogs.render` takes them.

    Attributes:
        cameras: Cameras, or how to choose them.
        views: Number of automatic views.
        pixels: Size of automatic views: one number for width and height, or both.
        up: (3,) up direction of automatic views; None to find it from the model.
    """

    cameras: Cameras = "auto"
    views: int = VIEWS
    pixels: int | tuple[int, int] = PIXELS
    up: Sequence[float] | None = None


@dataclass(frozen=True, slots=True)
class RenderFindings:
    """Results of `nanogs info` that need renders of the model.

    Attributes:
        modes: Evidence for either render mode.
        cost: Draw cost in the model's own render mode; None if it was not measured.
        notes: Remarks that matter for reading the numbers.
    """

    modes: ModeEvidence
    cost: DrawCost | None
    notes: tuple[str, ...]


class _Seen(NamedTuple):
    """A model, and the views that it is rendered on.

    Attributes:
        model: The model; a source if it is read some rows at a time.
        budget: Bytes for the splats of images; None if the model is in memory.
        cameras: The views.
        protocol: Their kind, number, size and split, and the background.
        photographs: A view for each of the photographs, decoded on access; or none.
        notes: Remarks that matter for reading the numbers.
    """

    model: Splats | Source
    budget: int | None
    cameras: "Sequence[Camera]"
    protocol: Protocol
    photographs: "Sequence[ReferenceView]"
    notes: tuple[str, ...]


def render_findings(
    model: Model,
    seen: ModelViews | Photographs = ModelViews(),  # noqa: B008 - immutable
    *,
    background: Iterable[float] | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
    costs: bool = True,
) -> RenderFindings:
    """Render a model in both modes and, with `costs`, measure its draw cost.

    Args:
        model: The model, or a path.
        seen: The views, or photographs to compare with.
        background: As for `mode_evidence`.
        threads: As for `mode_evidence`.
        max_memory: As for `mode_evidence`.
        progress: As for `mode_evidence`.
        costs: Whether to measure the draw cost.

    Raises:
        NanogsError: As for `mode_evidence`.
    """
    limit = None if max_memory is None else as_bytes(max_memory)
    behind = None if background is None else plain_background(background)
    wanted: str | list[Camera] = "auto"
    if isinstance(seen, ModelViews):
        wanted = known_cameras(seen.cameras, seen.up, seen.views, seen.pixels)
    stages = [Stage("cameras", 1.0), Stage("render", 6.0)]
    stages += [Stage("cover", 2.0)] if costs else []
    with opened(model) as source, show_progress(progress) as on_step:
        # Imported here because these import Numba.
        from nanogs.threads import use_threads
        from nanogs.views.covering import cost_on

        tracker = Tracker(on_step, stages)
        tracker.begin("cameras")
        with use_threads(threads):
            if isinstance(seen, Photographs):
                found = _with_photographs(source, seen, behind, limit)
            else:
                found = _with_views(source, seen, wanted, behind or BLACK, limit)
            some, budget, cameras, protocol, photographs, notes = found
            tracker.begin("render")
            truth = [view.image for view in photographs]  # decoded here
            modes = evidence_on(some, cameras, protocol, truth, budget, tracker.part)
            cost = None
            if costs:
                tracker.begin("cover")
                cost = cost_on(some, cameras, protocol, tracker.part)
        tracker.finish()
    return RenderFindings(modes, cost, notes)


def _with_views(
    source: Splats | Source,
    asked: ModelViews,
    wanted: "str | list[Camera]",
    background: Background,
    limit: int | None,
) -> _Seen:
    """Find the views of a model, and load it if it fits into memory.

    Args:
        source: The model.
        asked: The views.
        wanted: Their cameras, from `known_cameras`.
        background: RGB in [0, 1].
        limit: Bytes that this process may take, or None.
    """
    _, views, pixels, up = asked
    size, remedy = pictures_of(wanted, views, pixels), rendering_remedy(wanted)
    budget = budget_for_pictures(source, *size, limit, remedy=remedy)
    some = source_of(source).load() if budget is None else source
    cameras, kind = chosen_cameras(some, wanted, views, pixels, up)
    protocol = protocol_of(cameras, kind, background=background)
    return _Seen(some, budget, cameras, protocol, (), tuple(camera_notes(cameras)))


def _with_photographs(
    source: Splats | Source, asked: Photographs, background: Background | None, limit: int | None
) -> _Seen:
    """Open the photographs that a model is compared with, and load it if it fits into memory.

    Photographs have notes of their own.
    """
    from nanogs.scoring.photos import held_bytes, photographs, photographs_remedy

    found = photographs(*asked, background)
    cameras, held, remedy = list(found.cameras), held_bytes(found), photographs_remedy(found)
    size = pictures_of(cameras)
    budget = budget_for_pictures(source, *size, limit, photographs=held, remedy=remedy)
    some = source_of(source).load() if budget is None else source
    protocol = protocol_of(cameras, "photographs", asked.split, found.background)
    return _Seen(some, budget, cameras, protocol, found, found.notes)


def evidence_on(
    model: Splats | Source,
    cameras: "Sequence[Camera]",
    protocol: Protocol,
    photographs: "Sequence[F32]",
    budget: int | None,
    on_progress: PartProgress,
) -> ModeEvidence:
    """Compute the evidence on given views, each rendered in both modes.

    Args:
        model: The model.
        cameras: The views.
        protocol: Their kind, number, size and split.
        photographs: (H, W, 3) for each view, or none.
        budget: Bytes for the splats of images, to stream the model; None to hold it in memory.
        on_progress: Receives the progress in images rendered.
    """
    import numpy as np

    from nanogs.metrics import psnr
    from nanogs.scoring.scores import mean_psnr
    from nanogs.views.streamed import drawable, renderings

    thin, faded = _splats_in_sight(model, cameras)
    shown: list[tuple[F32, F32]] = []
    leaks, apart = np.zeros(2), []
    psnrs: dict[RenderMode, list[float]] = {mode: [] for mode in MODES if photographs}
    for mode in MODES:
        tagged = drawable(Tagged(source_of(model), mode), budget)
        done = MODES.index(mode) * len(cameras)
        pictures = renderings(tagged, cameras, background=protocol.background)
        for number, picture in enumerate(pictures):
            on_progress(done + number, len(MODES) * len(cameras))
            image = picture.shown()
            if photographs:
                psnrs[mode].append(psnr(photographs[number], image))
            if mode is RenderMode.DEFAULT:
                shown.append((image, picture.alpha))
                continue
            before, alpha = shown[number]
            apart.append(psnr(before, image))
            full = alpha >= OPAQUE
            leaks += (1 - picture.alpha[full]).sum(dtype=np.float64), np.count_nonzero(full)
    return ModeEvidence(
        thin=thin,
        faded=faded,
        leak=float(leaks[0] / leaks[1]) if leaks[1] else None,
        between=mean_psnr(apart),
        photographs={mode.value: mean_psnr(values) for mode, values in psnrs.items()},
        protocol=protocol,
    )


def _splats_in_sight(model: Splats | Source, cameras: "Sequence[Camera]") -> tuple[float, float]:
    """Return the shares of visible splats that are thin and faded; see `ModeEvidence`."""
    import numpy as np

    from nanogs.kernels.project import HIDDEN
    from nanogs.raster.rendering import prepare, project_rows
    from nanogs.views.streamed import DRAWN_ROWS

    seen = thin = faded = 0
    for rows in source_of(model).blocks(DRAWN_ROWS):
        least = rows.scales().min(axis=1, initial=np.inf).astype(np.float64)
        prepared = prepare(replace(rows, render_mode=RenderMode.DEFAULT))
        for camera in cameras:
            geometry, features, boxes = project_rows(prepared, camera, sh_degree=0)
            sight = np.flatnonzero(boxes != HIDDEN)
            widths = least[sight] * max(camera.fx, camera.fy) / features[sight, 3]
            seen += len(sight)
            thin += int(np.count_nonzero(widths < np.sqrt(camera.dilation)))
            factors = _antialiasing_factors(geometry[sight], camera.dilation)
            faded += int(np.count_nonzero(factors < FADED))
    return (thin / seen, faded / seen) if seen else (0.0, 0.0)


def _antialiasing_factors(geometry: "F64", dilation: float) -> "F64":
    """Compute the antialiasing factor (N,) of opacities: sqrt(det before / det after dilation).

    Args:
        geometry: (N, 8), see `nanogs.kernels.project`; after dilation.
        dilation: Variance that was added on screen, pixels².
    """
    import numpy as np

    yy, slope = 1 / geometry[:, 4], geometry[:, 3]
    along = 1 / geometry[:, 2] ** 2  # the variance of x given y
    before = (along + slope**2 * yy - dilation) * (yy - dilation) - (slope * yy) ** 2
    kept: F64 = np.sqrt(np.maximum(before, 0) / (along * yy))
    return kept
