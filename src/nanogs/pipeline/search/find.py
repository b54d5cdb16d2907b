"""The search that a goal needs, for results of a model in memory and of a scene in blocks alike."""

from collections.abc import Callable

from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.search.draw_cost import search_draw_cost
from nanogs.pipeline.search.files import Files
from nanogs.pipeline.search.fill_size import fill_size
from nanogs.pipeline.search.packer import Packer, PackingForPsnr
from nanogs.pipeline.search.psnr import search_psnr
from nanogs.pipeline.search.results import Delivered, Results, T
from nanogs.pipeline.search.size_request import SizeRequest
from nanogs.progress import Tracker
from nanogs.scoring.draw_views import draw_views
from nanogs.scoring.held_out import held_out
from nanogs.splats import Splats


def find_result(
    goal: Goal,
    request: SizeRequest,
    results: Callable[[], Results[T]],
    sample: Callable[[], Splats],
    files: Files[T],
    progress: Tracker,
    max_memory: int | None = None,
) -> Delivered[T]:
    """Find the result that meets a size, a PSNR or a draw cost.

    The original is rendered before results are asked for, so that a model that shows nothing is
    refused at once.

    Args:
        goal: One of the three.
        request: What is asked of the file; its `size` counts only if that is the goal.
        results: Returns what makes results of the model.
        sample: Returns some usable splats of the model.
        files: Writes and measures results.
        progress: Notified of each stage.
        max_memory: Bytes that this process may take to render a source; by default what is free.

    Raises:
        TooSmallError: No result is as small as asked, or draws as little.
        ModelError: A PSNR or a draw cost is asked of a model that shows nothing.
    """
    if goal.size is not None:
        return fill_size(Packer(results(), request, sample(), files, progress))
    progress.begin("measure")
    if goal.psnr is not None:
        with files.clock.time("measure"), files.open_original() as original:
            views = held_out(original, progress.part, max_memory)
        pack = PackingForPsnr(results(), request, sample, files, progress)
        return search_psnr(pack, goal.psnr, views)
    assert goal.draw_cost is not None, "other goals are known counts"  # noqa: S101
    with files.clock.time("measure"), files.open_original() as original:
        drawn = draw_views(original, progress.part)
    return search_draw_cost(results(), goal.draw_cost, drawn, files, progress)
