"""A comparison on several sets of views."""

from collections.abc import Sequence
from dataclasses import replace

from nanogs.progress import Tracker
from nanogs.protocol import BLACK, Background, Kind
from nanogs.scoring.comparison import (
    USUAL,
    Comparison,
    NamedModel,
    Scoring,
    Sheet,
    compare_models,
)
from nanogs.scoring.view_sets import ViewSet


def compare_on_sets(
    reference: NamedModel,
    models: Sequence[NamedModel],
    sets: Sequence[ViewSet],
    *,
    background: Background = BLACK,
    scoring: Scoring = USUAL,
    progress: Tracker | None = None,
) -> tuple[Comparison, list[Sheet]]:
    """Score models against a reference model on several sets of views.

    Args:
        reference: The reference.
        models: At least one.
        sets: At least one; the result on the first holds the others in `further`.
        background: RGB in [0, 1] behind the splats.
        scoring: What is measured; pictures are made of each kind at its first size.
        progress: Receives the stages "render" and "score" of each set.

    Raises:
        OptionError: No model is given.
        ModelError: Nothing of the reference is visible in any view of a set.
    """
    comparisons, sheets = [], []
    pictured: set[Kind] = set()
    for views in sets:
        comparison, some = compare_models(
            reference,
            models,
            views.cameras,
            kind=views.kind,
            background=background,
            scoring=replace(scoring, pictures=scoring.pictures and views.kind not in pictured),
            progress=progress,
        )
        pictured.add(views.kind)
        comparisons.append(replace(comparison, notes=(*views.notes, *comparison.notes)))
        label = comparison.protocol.label if len(sets) > 1 else ""
        sheets += [replace(sheet, label=label) for sheet in some]
    return replace(comparisons[0], further=tuple(comparisons[1:])), sheets
