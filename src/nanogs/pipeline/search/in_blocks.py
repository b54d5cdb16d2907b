"""The search for the count of a job in blocks."""

from functools import partial
from pathlib import Path

from nanogs.io import registry
from nanogs.io.format import FormatOptions
from nanogs.pipeline.job.rows import sample
from nanogs.pipeline.options.presets import renders
from nanogs.pipeline.run import Done, Run
from nanogs.pipeline.search.file_size import SIZE_SAMPLE
from nanogs.pipeline.search.find import find_result
from nanogs.pipeline.search.job_files import JobFiles
from nanogs.pipeline.search.job_results import JobResults
from nanogs.pipeline.search.size_request import SizeRequest
from nanogs.pipeline.work import SHORT_RUN, Work
from nanogs.progress import Tracker
from nanogs.splats import Splats


def find_in_blocks(
    output: Path,
    options: FormatOptions | None,
    folder: Path,
    max_memory: int | None,
    work: Work,
    run: Run,
    progress: Tracker,
) -> Done:
    """Find the result of a job that meets its target; see `SearchTarget`.

    Args:
        output: Path of the file to be written.
        options: Of its format.
        folder: Folder of the job, where files are written to be measured.
        max_memory: Bytes that this process may take; by default what is free.
        work: The job; the stages before the results are done.
        run: Does its tasks.
        progress: Notified of each stage.

    Raises:
        TooSmallError: No result is as small as asked.
        OptionError: A result is too large to be written.
        ModelError: A PSNR or a draw cost is asked of a model that shows nothing.
    """
    settings, sought = work.settings, work.settings.search
    assert sought is not None  # noqa: S101 - a search has a target
    goal, known, given = sought.goal, registry.writable(output), options or {}
    looks = renders(settings.parameters)
    request = SizeRequest(
        goal.size or 0, known, given, settings.sh_degree, looks=looks, most=sought.most
    )
    results = JobResults(work, run, settings)
    files = JobFiles(output, given, folder, max_memory, work, run.clock)
    result, fields, notes = find_result(
        goal, request, lambda: results, partial(_sample, work), files, progress, max_memory
    )
    prepared = partial(files.prepared, result)
    return Done(result.work, run.kept, (result.level,), fields, notes, prepared)


def _sample(work: Work) -> Splats:
    return sample(work.settings, work.unpacked(), rows=SIZE_SAMPLE, span=SHORT_RUN, bare=False)
