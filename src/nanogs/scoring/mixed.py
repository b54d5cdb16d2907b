"""`nanogs.compare_mixed`: score streamed models as viewers draw them, far chunks coarser."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nanogs.bar import show_progress
from nanogs.errors import OptionError
from nanogs.formatting import counted, notes_on_views
from nanogs.io import inspect
from nanogs.io.models import Model, as_splats
from nanogs.io.registry import ARCHIVE, LEVELS
from nanogs.io.url_files import refuse_address
from nanogs.io.urls import as_path
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.memory_estimates import model_bytes, models_bytes, scoring_bytes
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import BLACK, PIXELS, Background, Protocol, plain_background
from nanogs.quantities import as_bytes
from nanogs.ranges import is_number, value_text
from nanogs.raster.camera import camera_notes
from nanogs.scoring.api import checked_names, names_of
from nanogs.scoring.view_sets import ComparedViews, Pixels, ViewSet, compared_views
from nanogs.splats import Splats
from nanogs.views.cameras import Cameras

if TYPE_CHECKING:
    from nanogs.scoring.mixed_views import MixedView, StreamLevels

SEAM_LOSS = 0.3  # dB; a higher loss at seams gets a note


@dataclass(frozen=True, slots=True)
class MixedScore:
    """The scores of a stream on one set of views.

    Attributes:
        name: Its name.
        levels: Splats of each level, the finest first.
        environment: Splats that are drawn with every level; not counted in `levels`.
        budget: Splats that a viewer draws at once; None to choose levels by distance alone.
        protocol: The conditions of measurement.
        psnr: Mean over the views, dB.
        ssim: Mean over the views.
        coarse_psnr: PSNR of the coarsest level that is drawn in each view, drawn alone; mean, dB.
        coarse_ssim: SSIM of that level, mean.
        seam_loss: Ratio, dB, of the squared error of pixels at seams to that of the coarser of the
            levels that meet there, drawn alone; squares are summed over all views. Below 0 if the
            mixture is better; None without seams.
        seams: Share of all pixels that are at seams, in [0, 1].
        views: The scores of each view.
    """

    name: str
    levels: tuple[int, ...]
    environment: int
    budget: int | None
    protocol: Protocol
    psnr: float
    ssim: float
    coarse_psnr: float
    coarse_ssim: float
    seam_loss: float | None
    seams: float
    views: tuple["MixedView", ...]


@dataclass(frozen=True, slots=True)
class MixedComparison:
    """The result of `compare_mixed`.

    Attributes:
        reference: Name of the original.
        reference_splats: Its splats.
        scores: The scores of each stream on each set of views.
        notes: Remarks that matter for reading the numbers.
    """

    reference: str
    reference_splats: int
    scores: tuple[MixedScore, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, lists, numbers and strings."""
        return asdict(self)


def compare_mixed(
    original: Model,
    *streams: str | PathLike[str],
    names: Sequence[str] | None = None,
    budget: int | None = None,
    cameras: Cameras | Sequence[str] = "auto",
    views: int | None = None,
    pixels: Pixels = PIXELS,
    up: Sequence[float] | None = None,
    background: Iterable[float] = BLACK,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
) -> MixedComparison:
    """Score streamed SOGs against their original, drawn like the PlayCanvas engine draws them.

    For each view, each chunk is drawn at the level chosen by `views.chunk_levels`. All levels are
    held in memory.

    Args:
        original: The model that the streams were made from, or its path.
        *streams: At least one `lod-meta.json` or `.ssog`.
        names: Names of the original and of the streams; by default those of their files.
        budget: Splats that the viewer draws at once, 1 or more: levels are as fine as that allows.
            By default levels are chosen by distance alone.
        cameras: The views to draw, as for `compare`.
        views: Number of automatic views, as for `compare`.
        pixels: Size of the views, as for `compare`.
        up: Up direction of automatic views, or None.
        background: RGB in [0, 1] behind the splats.
        threads: Threads to use; all by default.
        max_memory: Bytes that this process may take, a number or a text such as "4GB"; by default
            the free memory, less a tenth.
        progress: As for `compare`.

    Returns:
        The scores of each stream on each set of views, their means and those of each view.

    Raises:
        FormatError: A model or the cameras cannot be read.
        ModelError: Nothing of the original is visible in any view.
        NotEnoughMemoryError: It takes more memory than is free or allowed.
        OptionError: An argument is out of range, no stream is given, or a path is not a stream.
    """
    paths = [as_path(stream) for stream in streams]
    for path in paths:
        refuse_address(path, "download the stream, and give the path of its file")
    called = _names(original, paths, names)
    budget = _checked(paths, budget)
    requested = compared_views(cameras, pixels, views, up)
    background = plain_background(background)
    limit = None if max_memory is None else as_bytes(max_memory)
    _refuse_too_large(original, paths, requested, limit)
    # Imported here because these import Numba.
    from nanogs.scoring.mixed_views import read_levels
    from nanogs.threads import use_threads

    scores, notes = list[MixedScore](), list[str]()
    with use_threads(threads), show_progress(progress) as on_step:
        tracker = Tracker(on_step, _stages(len(paths), requested.sets_count))
        tracker.begin("read")
        whole = as_splats(original)
        if not isinstance(original, Splats):  # a model in memory has been read before
            notes += [f"{called[0]}: {note}" for note in whole.notes]
        drawn = _Drawn(called[1:], [read_levels(path) for path in paths], background, budget)
        for found in requested.sets(whole):
            made, own = _score_on(found, whole, drawn, tracker)
            scores += made
            notes += own
        tracker.finish()
    return MixedComparison(called[0], len(whole), tuple(scores), tuple(dict.fromkeys(notes)))


class _Drawn(NamedTuple):
    """The streams, and how they are drawn.

    Attributes:
        names: Their names.
        levels: Their levels.
        background: RGB in [0, 1].
        budget: Splats that a viewer draws at once; None to choose levels by distance alone.
    """

    names: Sequence[str]
    levels: "Sequence[StreamLevels]"
    background: Background
    budget: int | None


def _score_on(
    found: ViewSet, whole: Splats, drawn: _Drawn, progress: Tracker
) -> tuple[list[MixedScore], list[str]]:
    """Score the streams on one set of views; return the scores, and notes on views and streams."""
    from nanogs.raster.rendering import prepare
    from nanogs.scoring.scores import reference_views
    from nanogs.views.costing import protocol_of

    progress.begin("render")
    seen, empty = reference_views(
        prepare(whole), found.cameras, drawn.background, progress.part, depth=False
    )
    notes = [*found.notes, *camera_notes(found.cameras)]
    notes += notes_on_views(empty, "nothing of the original is visible; left out")
    cameras = [view.camera for view in seen]
    protocol = protocol_of(cameras, found.kind, background=drawn.background)
    progress.begin("score")
    scores: list[MixedScore] = []
    for done, (name, stream) in enumerate(zip(drawn.names, drawn.levels, strict=True)):
        views: list[MixedView] = []
        for number, view in enumerate(seen):
            progress.part(done * len(seen) + number, len(drawn.names) * len(seen))
            views.append(stream.score(view, drawn.background, drawn.budget))
        levels = tuple(np.diff(stream.ends).tolist())
        apart = stream.chunks.environment
        scores.append(_means(name, levels, apart, drawn.budget, protocol, views))
        notes += _notes(scores[-1], len(stream.chunks.boxes))
    return scores, notes


def _names(original: Model, paths: Sequence[Path], names: Sequence[str] | None) -> list[str]:
    """Return the names of the original and of the streams."""
    if names is None:
        return names_of([original, *paths])
    return list(checked_names(names, 1 + len(paths), "for the original and for each stream"))


def _checked(paths: Sequence[Path], budget: int | None) -> int | None:
    """Check the streams, and the budget, which is returned as a number of Python's."""
    if not paths:
        raise OptionError("Give at least one lod-meta.json or .ssog to compare with the original.")
    for path in paths:
        if path.name != LEVELS and path.suffix.lower() != ARCHIVE:
            raise OptionError(
                f"{path} has no chunks of several levels to mix; give a {LEVELS} or an {ARCHIVE}."
            )
    if budget is not None and not (is_number(budget, whole=True) and budget >= 1):
        raise OptionError(f"The budget must be 1 splat or more, not {value_text(budget)}.")
    return None if budget is None else int(budget)


def _refuse_too_large(
    original: Model, paths: Sequence[Path], requested: ComparedViews, limit: int | None
) -> None:
    """Fail if the original and all levels of all streams do not fit in memory together."""
    held = models_bytes([original], all_of_it=bool(limit))
    counts = [0]
    for path in paths:
        infos = [inspect(path, level=level) for level in range(len(_levels(path)))]
        held += 2 * sum(map(model_bytes, infos))  # the levels as read, and concatenated
        counts.append(sum(info.splats for info in infos))
    needed = held + scoring_bytes(counts, *requested.pictures)
    refuse_too_large("Comparing mixed levels", needed, allowed_memory(limit), requested.remedy)


def _levels(path: Path) -> Sequence[int]:
    from nanogs.io import open as open_model

    with open_model(path) as source:
        return source.levels


def _stages(streams: int, sets: int) -> list[Stage]:
    looking = [Stage("render", 1.0), Stage("score", 4.0 * streams)]
    return [Stage("read", 1.0 + streams), *looking * sets]


def _means(
    name: str,
    levels: tuple[int, ...],
    environment: int,
    budget: int | None,
    protocol: Protocol,
    views: Sequence["MixedView"],
) -> MixedScore:
    from nanogs.scoring.mixed_views import loss_of
    from nanogs.scoring.scores import mean_psnr

    seams = float(np.mean([view.seams for view in views]))
    errors = [sum(view.seam_error for view in views), sum(v.seam_coarse_error for v in views)]
    return MixedScore(
        name=name,
        levels=levels,
        environment=environment,
        budget=budget,
        protocol=protocol,
        psnr=mean_psnr([view.psnr for view in views]),
        ssim=float(np.mean([view.ssim for view in views])),
        coarse_psnr=mean_psnr([view.coarse_psnr for view in views]),
        coarse_ssim=float(np.mean([view.coarse_ssim for view in views])),
        seam_loss=loss_of(errors[0], errors[1]) if seams else None,
        seams=seams,
        views=tuple(views),
    )


def _notes(score: MixedScore, chunks: int) -> list[str]:
    """Return notes on a score, one sentence each.

    Args:
        score: The score of a stream.
        chunks: Number of chunks of the stream.
    """
    where, least = f"{score.name}, {score.protocol.label}", score.levels[-1]
    if score.budget is not None and score.budget < least:
        floor = (
            f"{where}: the coarsest level, {counted(least, 'splat')}, exceeds the budget and is"
            f" drawn nevertheless; give a `budget` of {least:,} or more, or make a coarser level"
            " (`levels`)."
        )
        return [floor]
    if score.seam_loss is None:
        unmixed = f"{where}: no levels meet in any view, so seams could not be measured; "
        if chunks == 1:
            return [f"{unmixed}the stream is a single chunk, make it with smaller ones (`chunk`)."]
        counts = ", ".join(f"{count:,}" for count in score.levels)
        return [f"{unmixed}a `budget` between the splats of two levels ({counts}) mixes them."]
    if score.seam_loss <= SEAM_LOSS:
        return []
    worse = (
        f"{where}: where levels meet, pictures are {score.seam_loss:.2f} dB worse than the"
        " coarser level alone, which may be visible as lines; make the stream with larger chunks"
        " (`chunk`)."
    )
    return [worse]
