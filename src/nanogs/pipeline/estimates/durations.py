"""Lists of the stages of each call and their estimated durations, for its progress."""

from collections.abc import Sequence

from nanogs.block_layouts import Linked
from nanogs.io.format import Format
from nanogs.method.paper.parameters import PaperParameters
from nanogs.method.parameters import ForestParameters
from nanogs.pipeline.estimates.stage_weights import (
    COUNTS,
    PACKINGS,
    RESULTS,
    SIZES,
    Load,
    level_stage,
    measure_stage,
    published_stages,
    write_weight,
)
from nanogs.pipeline.options.presets import Parameters, renders
from nanogs.pipeline.options.settings import Settings
from nanogs.pipeline.options.target import Goal, rounds_for_file
from nanogs.pipeline.stages import held_stages, level_stages, stages_of
from nanogs.progress import Stage


def job_stages(settings: Settings) -> list[Stage]:
    """List the stages of a job in blocks, each weighted by its estimated duration."""
    ratios = settings.ratios or tuple(count / settings.splats for count in settings.counts)
    block_layout, millions = settings.block_layout, settings.splats / 1e6
    encoding = block_layout.weight if block_layout else 1.0
    stages = []
    for stage, level in stages_of(settings):
        share = ratios[level] if stage.levels is None else 1.0
        load = Load(settings.parameters, millions, share * millions, encoding)
        stages.append(Stage(stage.name, stage.weight(load)))
    if (sought := settings.search) is not None:
        splats = settings.splats
        before, after = search_stages(
            sought.goal.is_measured, settings.parameters, splats, sought.suffix
        )
        stages += [*before, *after]
    writing = block_layout.weight * sum(ratios) if isinstance(block_layout, Linked) else 0.1
    return [*stages, Stage("write", writing * millions)]


def result_stages(settings: Settings, count: int) -> list[Stage]:
    """List the stages of one result of a job in blocks."""
    load = Load(settings.parameters, settings.splats / 1e6, count / 1e6)
    return [Stage(stage.name, stage.weight(load)) for stage, _ in level_stages(settings, 0)]


def build_stages(parameters: Parameters, splats: int) -> list[Stage]:
    """List the stages of a model in memory that run once, whatever the count.

    Args:
        parameters: Of the method; for `paper` there are none: everything runs for each count.
        splats: Number of splats of the model.
    """
    if isinstance(parameters, PaperParameters):
        return []
    return _weighed(parameters, splats, splats, results=False)


def delivery_stages(parameters: Parameters, splats: int, count: int) -> list[Stage]:
    """List the stages of a model in memory that run for each count."""
    if isinstance(parameters, PaperParameters):
        return published_stages(splats)
    return _weighed(parameters, splats, count, results=True)


def _weighed(
    parameters: ForestParameters, splats: int, count: int, *, results: bool
) -> list[Stage]:
    load = Load(parameters, splats / 1e6, count / 1e6)
    return [Stage(stage.name, stage.weight(load)) for stage in held_stages(load, results=results)]


def simplify_stages(
    parameters: Parameters, goal: Goal, splats: int, count: int | None, known: Format
) -> list[Stage]:
    """List the stages of `simplify`.

    Args:
        parameters: Parameters of the method.
        goal: The target of the simplification.
        splats: Number of splats of the model.
        count: The count that meets the goal, or None if it has to be searched for.
        known: Format of the file.
    """
    once = build_stages(parameters, splats)
    if isinstance(parameters, PaperParameters) or count is not None:
        return [*once, *count_stages(parameters, splats, count or splats, known)]
    before, after = search_stages(goal.is_measured, parameters, splats, known.suffix)
    return [*before, *once, *after]


def search_stages(
    measured: bool, parameters: ForestParameters, splats: int, suffix: str
) -> tuple[list[Stage], list[Stage]]:
    """List the stages before a search for a count, and those of the search itself.

    Args:
        measured: Whether the goal is measured on views; otherwise it is a size.
        parameters: Parameters of the method.
        splats: Number of splats of the model.
        suffix: Suffix of the file that a size refers to.
    """
    typical, millions = splats // 10, splats / 1e6
    weight = sum(stage.weight for stage in delivery_stages(parameters, splats, typical))
    looks = renders(parameters)
    writing = write_weight(suffix, typical)
    packing = [
        Stage("guess", writing / 5),
        Stage("pack", measure_stage(splats).weight + PACKINGS * (2 * writing + weight)),
    ]
    if measured:
        search = [Stage("search", COUNTS * (0.1 + 0.4 * millions))]
        search += [*packing, Stage("deliver", COUNTS * (weight + 0.1))] if looks else []
        return [measure_stage(splats)], search
    search = packing if looks else packing[:1]
    search = [*search, Stage("search", SIZES * (writing + 0.3 * millions))]
    search += [Stage("deliver", RESULTS * (writing + weight))] if looks else []
    return [], search


def count_stages(
    parameters: Parameters, splats: int, count: int, known: Format | None
) -> list[Stage]:
    """List the stages that make a result of a count from what all counts share.

    Args:
        parameters: Parameters of the method.
        splats: Number of splats of the model.
        count: Of the result.
        known: Format of its file, for which it may be rounded; None if it has none of its own.
    """
    stages = delivery_stages(parameters, splats, count)
    if rounds_for_file(parameters, known):
        stages.append(Stage("encode", 4 * count / 1e6))
    return stages


def levels_stages(
    parameters: Parameters, splats: int, counts: Sequence[int], known: Format | None
) -> list[Stage]:
    """List the stages of `levels`: those that run once, and one for each level.

    Args:
        parameters: Parameters of the method.
        splats: Number of splats of the model.
        counts: Of the levels.
        known: Format that each level is a file of; None if files hold parts of levels.
    """
    each = [count_stages(parameters, splats, count, known) for count in counts]
    levels = [
        Stage(level_stage(number), sum(stage.weight for stage in stages))
        for number, stages in enumerate(each)
    ]
    return [*build_stages(parameters, splats), *levels]
