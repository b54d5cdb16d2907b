"""Several models held against one reference, on one set of views."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from typing import Any

from nanogs.costs import DrawCost
from nanogs.errors import OptionError
from nanogs.formatting import counted, number_text, undrawn
from nanogs.progress import Tracker
from nanogs.protocol import BLACK, Background, Judged, Kind, Protocol
from nanogs.raster.camera import Camera
from nanogs.raster.lens import lens_notes
from nanogs.raster.rendering import Rendering
from nanogs.scoring.pictures import data_uri, error_map
from nanogs.scoring.scores import (
    ModelScore,
    ReferenceView,
    ViewScore,
    reference_views,
    score,
)
from nanogs.scoring.unpacked import Unpacked
from nanogs.source import Source, source_of
from nanogs.splats import Splats
from nanogs.views.costing import views_of
from nanogs.views.covering import cost_on
from nanogs.views.streamed import drawable


@dataclass(frozen=True, slots=True, eq=False)
class NamedModel:
    """A model and what the user calls it.

    Attributes:
        name: Its name; models of one name are taken as one method at several sizes.
        splats: The model; a source is read some rows at a time where `compare_models` is given
            room for that, and held else.
        file_bytes: Size of its file, or None.
        packed: Suffix of the format where it is read back from a file, to be held against the same
            model unpacked too, the last one before it without a suffix; else empty.
    """

    name: str
    splats: Splats | Source
    file_bytes: int | None = None
    packed: str = ""

    @property
    def sh_degree(self) -> int:
        """Degree of its spherical harmonics."""
        return source_of(self.splats).columns.sh_degree


@dataclass(frozen=True, slots=True, repr=False)
class Comparison:
    """The result of `compare`.

    Attributes:
        reference: What the scores are against: a model's name, or the photographs' folder.
        reference_splats: Splats of the reference model, or None for photographs.
        protocol: How it was measured.
        views: Names of the views that were scored.
        skipped_views: Names of views in which the reference is not seen; in no mean.
        models: Scores, in the order given.
        notes: What the reader of the numbers should know.
        further: The same on each further kind and size of views that was asked for.
        reference_cost: What the reference takes to draw on the views that were scored; None for
            photographs, or where that was not measured.
    """

    reference: str
    reference_splats: int | None
    protocol: Protocol
    views: tuple[str, ...]
    skipped_views: tuple[str, ...]
    models: tuple[ModelScore, ...]
    notes: tuple[str, ...]
    further: tuple["Comparison", ...] = ()
    reference_cost: DrawCost | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and strings."""
        return asdict(self)

    def __repr__(self) -> str:
        return "\n".join(
            f"{model.name}: {counted(model.splats, 'splat')}, {one.judged(place).text}, SSIM"
            f" {number_text(model.ssim, 4)}{_cost_text(model)}"
            for one in self.each
            for place, model in enumerate(one.models)
        )

    @property
    def each(self) -> tuple["Comparison", ...]:
        """This one and the further ones: one for each kind and size of views."""
        return (self, *self.further)

    @property
    def all_notes(self) -> list[str]:
        """Notes of each, those of models behind their names, once each."""
        notes = [note for one in self.each for note in one.notes]
        for one in self.each:
            notes += [f"{model.name}: {note}" for model in one.models for note in model.notes]
        return list(dict.fromkeys(notes))

    def judged(self, place: int) -> Judged:
        """The means of one of the models, with how they were measured."""
        model = self.models[place]
        return Judged(model.psnr, model.ssim, self.protocol)


def _cost_text(model: ModelScore) -> str:
    return f", {model.packed.text}" if model.packed else ""


@dataclass(frozen=True, slots=True)
class Sheet:
    """Pictures of one view for the page, as `data:` addresses.

    Attributes:
        view: Name of the view.
        reference: The reference.
        results: One rendering for each model.
        errors: One error map for each model.
        scores: One score for each model.
    """

    view: str
    reference: str
    results: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    scores: list[ViewScore] = field(default_factory=list)


def compare_models(
    reference: NamedModel,
    models: Sequence[NamedModel],
    cameras: Sequence[Camera],
    *,
    kind: Kind = "given",
    background: Background = BLACK,
    extras: Sequence[str] = (),
    pictures: bool = False,
    costs: bool = False,
    room: int | None = None,
    progress: Tracker | None = None,
) -> tuple[Comparison, list[Sheet]]:
    """Score models against a reference model.

    Args:
        reference: The reference.
        models: At least one.
        cameras: The views.
        kind: Where they are from; all but "given" say that they are automatic test views.
        background: RGB in [0, 1] behind the splats.
        extras: Further metrics, names in `scoring.scores.EXTRA_METRICS`.
        pictures: Also make the pictures for a page; otherwise the sheets are empty.
        costs: Also measure what each model takes to draw, and the reference.
        room: Bytes for the splats of pictures, to read models some rows at a time; None to hold
            them.
        progress: Told of the stages "render", of the reference, and "score".

    Raises:
        OptionError: No model is given.
        ModelError: The reference is seen in none of the views.
    """
    progress = progress or Tracker(None, [])
    progress.begin("render")
    drawn = drawable(reference.splats, room)
    views, skipped = reference_views(drawn, cameras, background, progress.part)
    del drawn
    notes = [
        f"{name}: nothing of the reference is seen; left out of every mean" for name in skipped
    ]
    first = views[0].rendering
    if first and first.skipped:
        notes.append(f"the reference: {undrawn(first.skipped)}")
    notes += [*_degree_notes(reference, models), *lens_notes(cameras)]
    protocol = views_of(_cameras(views), kind, background=background)
    cost = cost_on(reference.splats, _cameras(views), protocol) if costs else None
    scores, sheets = score_models(
        models, views, protocol, extras=extras, pictures=pictures, costs=costs, room=room,
        progress=progress,
    )  # fmt: skip
    found = _comparison(
        reference.name, len(reference.splats), views, skipped, protocol, scores, notes
    )
    return replace(found, reference_cost=cost), sheets


def compare_with_photographs(
    source: str,
    models: Sequence[NamedModel],
    views: Sequence[ReferenceView],
    *,
    split: str,
    background: Background,
    extras: Sequence[str] = (),
    pictures: bool = False,
    costs: bool = False,
    room: int | None = None,
    progress: Tracker | None = None,
) -> tuple[Comparison, list[Sheet]]:
    """Score models against photographs.

    Args:
        source: Where the photographs are from, for the reader.
        models: At least one.
        views: Cameras and photographs, one at least, as `photos.photographs` gives them.
        split: Which of the data set's they are, "test" or "train".
        background: RGB in [0, 1] behind the splats and the photographs' transparent parts.
        extras: Further metrics, names in `scoring.scores.EXTRA_METRICS`.
        pictures: Also make the pictures for a page.
        costs: Also measure what each model takes to draw.
        room: As for `compare_models`.
        progress: Told of the stages "render", of the reference, and "score".

    Raises:
        OptionError: No model is given.
    """
    protocol = views_of(_cameras(views), "photographs", split, background)
    scores, sheets = score_models(
        models, views, protocol, extras=extras, pictures=pictures, costs=costs, room=room,
        progress=progress or Tracker(None, []),
    )  # fmt: skip
    return _comparison(source, None, views, [], protocol, scores, []), sheets


def _cameras(views: Sequence[ReferenceView]) -> list[Camera]:
    return [view.camera for view in views]


def score_models(
    models: Sequence[NamedModel],
    views: Sequence[ReferenceView],
    protocol: Protocol,
    *,
    extras: Sequence[str],
    pictures: bool,
    costs: bool,
    room: int | None,
    progress: Tracker,
) -> tuple[list[ModelScore], list[Sheet]]:
    """Score every model on the same views, and make the pictures on the way if they are wanted."""
    if not models:
        raise OptionError("Name at least one model to compare.")
    sheets = [Sheet(view.camera.name, data_uri(view.image)) for view in views if pictures]
    scores: list[ModelScore] = []
    unpacked = Unpacked(keep=any(model.packed for model in models))
    progress.begin("score")
    for model in models:
        unpacked.begin(model.packed)
        remaining = iter(sheets)
        done = count(len(scores) * len(views) + 1)

        # Called within this turn of the loop only.
        def scored(view: ReferenceView, rendering: Rendering, found: ViewScore) -> None:
            progress.part(next(done), len(models) * len(views))  # noqa: B023
            unpacked.see(rendering)
            if not pictures:
                return
            sheet = next(remaining)  # noqa: B023
            sheet.results.append(data_uri(rendering.shown()))
            sheet.errors.append(data_uri(error_map(view.image, rendering.shown())))
            sheet.scores.append(found)

        found = score(
            model.name,
            drawable(model.splats, room),
            views,
            protocol.background,
            file_bytes=model.file_bytes,
            extras=extras,
            on_view=scored,
        )
        if costs:
            found = replace(found, cost=cost_on(model.splats, _cameras(views), protocol))
        scores.append(unpacked.end(found))
    return scores, sheets


def _degree_notes(reference: NamedModel, models: Sequence[NamedModel]) -> list[str]:
    """Lower degrees are rendered as they are; the reader should know what the score includes."""
    degree = reference.sh_degree
    return [
        f"{model.name}: SH degree {model.sh_degree}, the reference has {degree}"
        for model in models
        if model.sh_degree != degree
    ]


def _comparison(
    reference: str,
    reference_splats: int | None,
    views: Sequence[ReferenceView],
    skipped: Sequence[str],
    protocol: Protocol,
    scores: Sequence[ModelScore],
    notes: Sequence[str],
) -> Comparison:
    return Comparison(
        reference=reference,
        reference_splats=reference_splats,
        protocol=protocol,
        views=tuple(view.camera.name for view in views),
        skipped_views=tuple(skipped),
        models=tuple(scores),
        notes=tuple(notes),
    )
