"""Scoring several models against one reference, on one set of views."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from typing import Any

from nanogs.costs import DrawCost
from nanogs.errors import OptionError
from nanogs.formatting import counted, notes_on_views, number_text, undrawn
from nanogs.progress import Tracker
from nanogs.protocol import BLACK, Background, Judged, Kind, Protocol
from nanogs.raster.camera import Camera, camera_notes
from nanogs.raster.rendering import Rendering
from nanogs.scoring.pictures import data_uri, error_map
from nanogs.scoring.scores import (
    ModelScore,
    ReferenceView,
    ViewScore,
    reference_views,
    score,
)
from nanogs.scoring.unpacked import UnpackedModel
from nanogs.source import Layout, Source, source_of
from nanogs.splats import Splats
from nanogs.views.cameras import frame_notes
from nanogs.views.costing import protocol_of
from nanogs.views.covering import cost_on
from nanogs.views.streamed import drawable


@dataclass(frozen=True, slots=True, eq=False)
class NamedModel:
    """A model and the name that the user gives it.

    Attributes:
        name: Its name; models of one name count as one method at several sizes.
        splats: The model. A source is read some rows at a time if `Scoring` has a `budget`, and
            otherwise loaded.
        file_bytes: Size of its file, or None.
        packed_as: Suffix of the format if the model is read back from a packed file; it is then
            also compared with the last model before it that has none. Otherwise empty.
    """

    name: str
    splats: Splats | Source
    file_bytes: int | None = None
    packed_as: str = ""


@dataclass(frozen=True, slots=True, repr=False)
class Comparison:
    """The result of `compare`.

    Attributes:
        reference: Name of the reference model, or the photographs' folder.
        reference_splats: Splats of the reference model, or None for photographs.
        protocol: The conditions of measurement.
        views: Names of the views that were scored.
        skipped_views: Names of views in which nothing of the reference is visible; not in means.
        models: Scores, in the order given.
        notes: Remarks that matter for reading the numbers.
        further: The comparisons on each further kind and size of views.
        reference_cost: Draw cost of the reference on the views that were scored; None for
            photographs, or if it was not measured.
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
        """Return plain dictionaries, lists, numbers and strings."""
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
    def protocol_texts(self) -> list[str]:
        """Full text of each protocol, with its label if there are several: kinds can read alike."""
        if not self.further:
            return [self.protocol.text]
        return [f"{one.protocol.text} ({one.protocol.label})" for one in self.each]

    @property
    def all_notes(self) -> list[str]:
        """The distinct notes of all comparisons, those of models prefixed by their names."""
        notes = [note for one in self.each for note in one.notes]
        for one in self.each:
            notes += [f"{model.name}: {note}" for model in one.models for note in model.notes]
        return list(dict.fromkeys(notes))

    def judged(self, place: int) -> Judged:
        """Return the mean scores of the model at index `place`, with the protocol."""
        model = self.models[place]
        return Judged(model.psnr, model.ssim, self.protocol)


def _cost_text(model: ModelScore) -> str:
    return f", {model.packed.text}" if model.packed else ""


@dataclass(frozen=True, slots=True)
class Sheet:
    """Pictures of one view for the page, as `data:` URLs.

    Attributes:
        view: Name of the view.
        reference: The reference image.
        results: One rendering for each model.
        errors: One error map for each model.
        scores: One score for each model.
        label: Label of the view's protocol, if it is one of several sets.
    """

    view: str
    reference: str
    results: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    scores: list[ViewScore] = field(default_factory=list)
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scoring:
    """The measurements of each model, and how models are read.

    Attributes:
        extras: Further metrics, names in `scoring.scores.EXTRA_METRICS`.
        pictures: Whether the pictures for a page are made, too; otherwise there are no sheets.
        costs: Whether the draw costs are measured, too.
        budget: Bytes for the splats of images, to stream models; None to hold them in memory.
    """

    extras: Sequence[str] = ()
    pictures: bool = False
    costs: bool = False
    budget: int | None = None


USUAL = Scoring()


def compare_models(
    reference: NamedModel,
    models: Sequence[NamedModel],
    cameras: Sequence[Camera],
    *,
    kind: Kind = "given",
    background: Background = BLACK,
    scoring: Scoring = USUAL,
    progress: Tracker | None = None,
) -> tuple[Comparison, list[Sheet]]:
    """Score models against a reference model.

    Args:
        reference: The reference.
        models: At least one.
        cameras: The views.
        kind: Kind of the views; all but "given" are automatic test views.
        background: RGB in [0, 1] behind the splats.
        scoring: What is measured; the draw cost of the reference, too, if those of models are.
        progress: Receives the stages "render", for the reference, and "score".

    Raises:
        OptionError: No model is given.
        ModelError: Nothing of the reference is visible in any view.
    """
    progress = progress or Tracker(None, [])
    progress.begin("render")
    drawn = drawable(reference.splats, scoring.budget)
    views, skipped = reference_views(drawn, cameras, background, progress.part)
    del drawn
    notes = notes_on_views(skipped, "nothing of the reference is visible; left out of every mean")
    first = views[0].rendering
    if first and first.skipped:
        notes.append(f"the reference: {undrawn(first.skipped)}")
    notes += [*_differences(reference, models), *camera_notes(cameras)]
    notes += frame_notes(cameras, reference.splats)
    protocol = protocol_of(_cameras(views), kind, background=background)
    cost = cost_on(reference.splats, _cameras(views), protocol) if scoring.costs else None
    scores, sheets = score_models(models, views, protocol, scoring, progress)
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
    scoring: Scoring = USUAL,
    progress: Tracker | None = None,
) -> tuple[Comparison, list[Sheet]]:
    """Score models against photographs.

    Args:
        source: The photographs' folder, as shown to the reader.
        models: At least one.
        views: Cameras and photographs, at least one, from `photos.photographs`.
        split: Their split of the data set, "test" or "train".
        background: RGB in [0, 1] behind the splats and the photographs' transparent parts.
        scoring: What is measured.
        progress: Receives the stage "score".

    Raises:
        OptionError: No model is given.
    """
    cameras = _cameras(views)
    protocol = protocol_of(cameras, "photographs", split, background)
    progress = progress or Tracker(None, [])
    scores, sheets = score_models(models, views, protocol, scoring, progress)
    notes = frame_notes(cameras, models[0].splats)
    return _comparison(source, None, views, [], protocol, scores, notes), sheets


def _cameras(views: Sequence[ReferenceView]) -> list[Camera]:
    return [view.camera for view in views]


def score_models(
    models: Sequence[NamedModel],
    views: Sequence[ReferenceView],
    protocol: Protocol,
    scoring: Scoring,
    progress: Tracker,
) -> tuple[list[ModelScore], list[Sheet]]:
    """Score each model on the same views, and make the pictures for a page if requested.

    Raises:
        OptionError: No model is given.
    """
    if not models:
        raise OptionError("Name at least one model to compare.")
    sheets = [Sheet(view.camera.name, data_uri(view.image)) for view in views if scoring.pictures]
    scores: list[ModelScore] = []
    unpacked = UnpackedModel(keep=any(model.packed_as for model in models))
    progress.begin("score")
    for model in models:
        unpacked.begin(model.packed_as)
        remaining = iter(sheets)
        done = count(len(scores) * len(views) + 1)

        # Not called after this iteration, so that it may use the loop's variables (B023).
        def scored(view: ReferenceView, rendering: Rendering, found: ViewScore) -> None:
            progress.part(next(done), len(models) * len(views))  # noqa: B023
            unpacked.see(view, rendering, found)
            if not scoring.pictures:
                return
            sheet = next(remaining)  # noqa: B023
            sheet.results.append(data_uri(rendering.shown()))
            sheet.errors.append(data_uri(error_map(view.image, rendering.shown())))
            sheet.scores.append(found)

        found = score(
            model.name,
            drawable(model.splats, scoring.budget),
            views,
            protocol.background,
            file_bytes=model.file_bytes,
            extras=scoring.extras,
            on_view=scored,
        )
        if scoring.costs:
            found = replace(found, cost=cost_on(model.splats, _cameras(views), protocol))
        scores.append(unpacked.end(found))
    return scores, sheets


def _differences(reference: NamedModel, models: Sequence[NamedModel]) -> list[str]:
    """Note models whose SH degree or render mode is not the reference's, by their names."""
    known = source_of(reference.splats).columns
    return [
        f"{model.name}: {note}"
        for model in models
        for note in layout_notes(source_of(model.splats).columns, known, "the reference")
    ]


def layout_notes(layout: Layout, reference: Layout, name: str) -> list[str]:
    """Note an SH degree and a render mode that are not the reference's: scores show them.

    Args:
        layout: Of the model that is scored.
        reference: Of the model that it is compared with.
        name: What the latter is called, such as "the reference".
    """
    notes = []
    if layout.sh_degree != reference.sh_degree:
        notes.append(f"SH degree {layout.sh_degree}, {name} has {reference.sh_degree}")
    if layout.render_mode != reference.render_mode:
        notes.append(
            f"render mode {layout.render_mode}, {name} has {reference.render_mode}, and each is"
            " drawn in its own"
        )
    return notes


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
