"""URLs in place of files, by `nanogs.io.stand_ins`, with what is fetched and sent shown."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nanogs.cli.progress import shown
from nanogs.io.collect import model_in
from nanogs.io.stand_ins import TransferProgress, local_copies
from nanogs.progress import Parts, Progress, Stage, Step, Tracker

DOWNLOAD = "download it to a file with the suffix of its format"


@contextmanager
def fetched(paths: Sequence[Path], *, quiet: bool) -> Iterator[list[Path]]:
    """Files in place of URLs and of folders with one model; other paths as they are.

    Raises:
        NanogsError: As for `local_copies` and `model_in`.
    """
    with local_copies(paths, telling=a_bar(quiet=quiet), remedy=DOWNLOAD) as (files, _):
        yield [model_in(file) for file in files]


def a_bar(*, quiet: bool) -> TransferProgress:
    """Show each transfer by itself, where nothing else is shown."""

    @contextmanager
    def begun(stage: str) -> Iterator[Parts]:
        with shown(quiet=quiet) as watch:
            tracker = Tracker(watch, [Stage(stage, 1.0)])
            tracker.begin(stage)
            yield tracker.part
            tracker.finish()

    return begun


def within(told: Progress) -> TransferProgress:
    """Show transfers as stages of a run that shows itself, and which they bring no further."""

    @contextmanager
    def begun(stage: str) -> Iterator[Parts]:
        yield lambda done, parts: told(Step(stage, 1, 1, done, max(parts, 1), 0.0))

    return begun
