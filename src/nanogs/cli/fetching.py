"""Downloads and uploads of URLs (`nanogs.io.url_files`), with their progress shown."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nanogs.cli.progress import shown
from nanogs.io.collect import model_in
from nanogs.io.url_files import TransferProgress, local_copies
from nanogs.progress import PartProgress, Progress, Stage, Step, Tracker

DOWNLOAD = "download it to a file with the suffix of its format"


@contextmanager
def fetched(paths: Sequence[Path], *, quiet: bool) -> Iterator[list[Path]]:
    """Replace each URL by its downloaded copy, and each folder by the one model in it.

    Other paths are yielded unchanged.

    Raises:
        NanogsError: As for `local_copies` and `model_in`.
    """
    with local_copies(paths, transfer=transfer_bar(quiet=quiet), remedy=DOWNLOAD) as (files, _):
        yield [model_in(file) for file in files]


def transfer_bar(*, quiet: bool) -> TransferProgress:
    """Return a callback that shows each transfer by a progress bar of its own."""

    @contextmanager
    def begun(stage: str) -> Iterator[PartProgress]:
        with shown(quiet=quiet) as watch:
            tracker = Tracker(watch, [Stage(stage, 1.0)])
            tracker.begin(stage)
            yield tracker.part
            tracker.finish()

    return begun


def within(on_step: Progress) -> TransferProgress:
    """Return a callback that reports transfers as stages of a run, at fraction 0 of the whole."""

    @contextmanager
    def begun(stage: str) -> Iterator[PartProgress]:
        yield lambda done, parts: on_step(Step(stage, 1, 1, done, max(parts, 1), 0.0))

    return begun
