"""The protocol: every scene, every wish, every method, each in a process of its own."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from nanogs.bench import measuring
from nanogs.bench.bjontegaard import check_packages
from nanogs.bench.rows import ORIGINAL, BenchRow, RowKey, Status, Wish
from nanogs.bench.scenes import BenchScene, scene_views
from nanogs.bench.settings import BenchSettings, refuse_twins
from nanogs.cleanup import temporary_folder
from nanogs.errors import NanogsError, OptionError
from nanogs.io import load
from nanogs.scoring.scores import EXTRA_METRICS
from nanogs.threads import use_threads

OnRow = Callable[[BenchRow], None]
Progress = Callable[[str], None]


def run_bench(
    scenes: Sequence[BenchScene],
    settings: BenchSettings,
    *,
    done: Sequence[BenchRow] = (),
    on_row: OnRow | None = None,
    progress: Progress | None = None,
) -> list[BenchRow]:
    """Measure; whatever cannot be measured is a row with the reason.

    Args:
        scenes: The scenes, of different names.
        settings: What to measure.
        done: Rows that were measured before and are taken as they are.
        on_row: Told of each row as it is done.
        progress: Told what is done next.

    Returns:
        Rows by scene, then wish, then method, the original model first; where files of sizes are
        asked for, then the original in each format, whole.

    Raises:
        OptionError: There is no scene, two have the same name, or a setting is out of range.
    """
    if not scenes:
        raise OptionError("Give at least one model to measure on.")
    refuse_twins("scene", [scene.name for scene in scenes])
    for pattern in settings.externals.values():
        measuring.external_path(pattern, scenes[0], settings.wishes[0])
    _try_metrics(settings.metrics)
    if settings.file_sizes:
        check_packages()
    rows = []
    known = {row.key: row for row in done}
    with use_threads(settings.threads):
        for scene in scenes:
            for row in _scene_rows(scene, settings, known, progress or (lambda _what: None)):
                rows.append(row)
                if on_row:
                    on_row(row)
    return rows


def _try_metrics(metrics: Sequence[str]) -> None:
    """Ask for each metric once, so that a missing package shows now and not after the first run."""
    image = np.zeros((64, 64, 3), np.float32)
    for metric in metrics:
        if metric not in EXTRA_METRICS:
            known = ", ".join(EXTRA_METRICS)
            raise OptionError(f"There is no metric {metric!r}; choose from {known}.")
        EXTRA_METRICS[metric](image, image)


def row_count(scenes: Sequence[BenchScene], settings: BenchSettings) -> int:
    """Rows that `run_bench` will deliver."""
    return len(scenes) * len(_all_runs(settings))


def _scene_rows(
    scene: BenchScene, settings: BenchSettings, known: Mapping[RowKey, BenchRow], progress: Progress
) -> Iterator[BenchRow]:
    keys = [(scene.name, *run) for run in _all_runs(settings)]
    if all(key in known for key in keys):
        yield from (known[key] for key in keys)
        return
    progress(f"{scene.name}: reading")
    try:
        splats = load(scene.model, render_mode=settings.render_mode)
        views = scene_views(scene, splats, settings)
    except NanogsError as error:
        yield from _skipped_rows(scene, settings, str(error))
        return
    whole: dict[str, int] = {}  # bytes of the model in each format
    with temporary_folder("nanogs-bench-") as folder:
        for key in (key for key in keys if key[1] == ORIGINAL):
            wish = key[2]
            progress(f"{scene.name}: {ORIGINAL} at {wish.text}")
            row = known.get(key)
            if row is None and wish.format:
                row = measuring.whole_row(scene, splats, wish, views, settings, folder)
            row = row or measuring.original_row(scene, splats, views, settings)
            whole[wish.format] = row.file_bytes or 0
            yield row
        finite = int(splats.finite().sum())
        del splats
        for key in (key for key in keys if key[1] != ORIGINAL):
            _, name, wish = key
            progress(f"{scene.name}: {name} at {wish.text}")
            if key in known:
                yield known[key]
            elif name not in settings.methods:
                yield measuring.external_row(scene, name, wish, finite, views, settings)
            elif wish.size is not None and 0 < whole[wish.format] <= wish.size:
                yield measuring.too_large_row(scene, name, wish, whole[wish.format])
            else:
                yield measuring.method_row(scene, name, wish, views, settings, folder)


def _skipped_rows(scene: BenchScene, settings: BenchSettings, reason: str) -> Iterator[BenchRow]:
    for name, wish in _all_runs(settings):
        yield replace(measuring.empty_row(scene, name, wish), status=Status.SKIPPED, reason=reason)


def _all_runs(settings: BenchSettings) -> list[tuple[str, Wish]]:
    """Method and wish of each row of a scene, in their order."""
    names = [*settings.methods, *settings.externals]
    formats = settings.formats if settings.file_sizes else ()
    wholes = [(ORIGINAL, Wish(1.0, suffix)) for suffix in ("", *formats)]
    return [*wholes, *((name, wish) for wish in settings.wishes for name in names)]
