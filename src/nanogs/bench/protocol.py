"""The protocol: every scene, every ratio, every method, each in a process of its own."""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from nanogs.bench.bjontegaard import check_packages
from nanogs.bench.gsplat import gsplat_fps
from nanogs.bench.rows import (
    ORIGINAL,
    Against,
    BenchRow,
    RowKey,
    SetScore,
    Status,
    Wish,
    size_name,
)
from nanogs.bench.scenes import BenchScene, SceneViews, fill, scene_of_file, scene_views
from nanogs.bench.settings import BenchSettings, refuse_twins
from nanogs.bench.worker import Job, run_job
from nanogs.cleanup import temporary_folder
from nanogs.errors import NanogsError, OptionError
from nanogs.formatting import counted
from nanogs.io import inspect, load, losses, save
from nanogs.pipeline.target import target_count
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, prepare, render
from nanogs.scoring.scores import EXTRA_METRICS, ModelScore, score
from nanogs.splats import Splats
from nanogs.threads import use_threads

OnRow = Callable[[BenchRow], None]
Progress = Callable[[str], None]

_FPS_VIEWS = 8  # renders behind a figure of frames a second


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
        _external_path(pattern, scenes[0], settings.wishes[0])
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
        splats = load(scene.model)
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
                row = _whole_row(scene, splats, wish, views, settings, folder)
            row = row or _original_row(scene, splats, views, settings)
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
                yield _external_row(scene, name, wish, finite, views, settings)
            elif wish.size is not None and 0 < whole[wish.format] <= wish.size:
                yield _too_large_row(scene, name, wish, whole[wish.format])
            else:
                yield _method_row(scene, name, wish, views, settings, folder)


def _empty_row(scene: BenchScene, method: str, wish: Wish) -> BenchRow:
    against = Against.ORIGINAL if scene.photos is None else Against.PHOTOGRAPHS
    return BenchRow(
        scene.name, method, wish.ratio, against=against, dataset=scene.dataset,
        format=wish.format, size=wish.size,
    )  # fmt: skip


def _too_large_row(scene: BenchScene, method: str, wish: Wish, whole: int) -> BenchRow:
    """A size that the whole model fits into, of which there is nothing to measure."""
    reason = f"The whole model as {wish.format} takes {whole:,} B, which fits into this size."
    return replace(_empty_row(scene, method, wish), status=Status.SKIPPED, reason=reason)


def _skipped_rows(scene: BenchScene, settings: BenchSettings, reason: str) -> Iterator[BenchRow]:
    for name, wish in _all_runs(settings):
        yield replace(_empty_row(scene, name, wish), status=Status.SKIPPED, reason=reason)


def _all_runs(settings: BenchSettings) -> list[tuple[str, Wish]]:
    """Method and wish of each row of a scene, in their order."""
    names = [*settings.methods, *settings.externals]
    formats = settings.formats if settings.file_sizes else ()
    wholes = [(ORIGINAL, Wish(1.0, suffix)) for suffix in ("", *formats)]
    return [*wholes, *((name, wish) for wish in settings.wishes for name in names)]


def _original_row(
    scene: BenchScene, splats: Splats, views: SceneViews, settings: BenchSettings
) -> BenchRow:
    row = replace(
        _empty_row(scene, ORIGINAL, Wish(1.0)),
        splats=len(splats),
        file_bytes=inspect(scene.model).file_bytes,
        label=next(iter(views.sets)),
        views=views.count,
        notes=(*views.notes, *splats.notes),
    )
    if views.against is Against.PHOTOGRAPHS:
        return _scored(row, splats, views, settings)
    # Against itself it would only score infinity; how fast it is drawn is of interest.
    return _timed(row, splats, prepare(splats), views)


def _whole_row(
    scene: BenchScene,
    splats: Splats,
    wish: Wish,
    views: SceneViews,
    settings: BenchSettings,
    folder: Path,
) -> BenchRow:
    """The whole model as a file of a format, so that packing alone is what costs."""
    row, path = _empty_row(scene, ORIGINAL, wish), folder / f"whole{wish.format}"
    start = time.perf_counter()
    try:
        save(splats, path)
        seconds = time.perf_counter() - start
        decoded = load(path)
    except NanogsError as error:
        return replace(row, status=Status.FAILED, reason=str(error))
    notes = (*losses(splats, path), *decoded.notes)
    row = replace(row, file_bytes=path.stat().st_size, seconds=seconds, notes=notes)
    path.unlink()
    return _scored(row, decoded, views, settings)


def _method_row(
    scene: BenchScene,
    method: str,
    wish: Wish,
    views: SceneViews,
    settings: BenchSettings,
    folder: Path,
) -> BenchRow:
    row = _empty_row(scene, method, wish)
    output = folder / f"result{wish.format or '.ply'}"
    job = Job(
        scene.model, method, wish.ratio or 1.0, output, views.fit_cameras, views.trained,
        settings.seed, settings.threads, wish.size,
    )  # fmt: skip
    outcome = run_job(job)
    if outcome.error:
        return replace(row, status=Status.FAILED, reason=outcome.error)
    row = replace(
        row,
        file_bytes=output.stat().st_size,
        seconds=outcome.seconds,
        read_seconds=outcome.read_seconds,
        peak_memory=outcome.peak_memory,
        notes=(*_count_note(outcome.splats, outcome.asked), *outcome.notes),
    )
    return _scored(row, load(output), views, settings)


def _external_row(
    scene: BenchScene,
    name: str,
    wish: Wish,
    finite: int,
    views: SceneViews,
    settings: BenchSettings,
) -> BenchRow:
    row = _empty_row(scene, name, wish)
    path = _external_path(settings.externals[name], scene, wish)
    if not path.exists():
        return replace(row, status=Status.SKIPPED, reason=f"There is no file {path}.")
    try:
        splats = load(path)
        row = replace(row, file_bytes=path.stat().st_size, **_producer_figures(path))
    except NanogsError as error:
        return replace(row, status=Status.FAILED, reason=str(error))
    if wish.size is not None:
        notes = _size_note(row.file_bytes or 0, wish.size)
    else:
        notes = _count_note(len(splats), target_count(finite, wish.ratio, None))
    return _scored(replace(row, notes=(*notes, *splats.notes)), splats, views, settings)


def _external_path(pattern: str, scene: BenchScene, wish: Wish) -> Path:
    """The file of another tool.

    Raises:
        OptionError: The pattern has a placeholder that is not known.
    """
    named = {"scene": scene.name, "model": scene_of_file(scene.model).name}
    if wish.size is None:
        named["ratio"] = f"{wish.ratio:g}"
    else:
        named |= {"size": size_name(wish.size), "format": wish.format.lstrip(".")}
    return Path(fill(pattern, **named))


def _size_note(taken: int, size: int) -> tuple[str, ...]:
    if taken <= size:
        return ()
    return (f"{taken:,} B, above the {size:,} B asked for",)


def _count_note(delivered: int, asked: int) -> tuple[str, ...]:
    if delivered == asked:
        return ()
    return (f"{counted(delivered, 'splat')} instead of the {asked:,} asked for",)


def _producer_figures(path: Path) -> dict[str, Any]:
    """Seconds and peak memory that whoever made the file noted beside it.

    Raises:
        OptionError: The note is not a JSON object of numbers.
    """
    note = path.with_name(path.name + ".json")
    if not note.exists():
        return {}
    try:
        noted = json.loads(note.read_text(encoding="utf-8"))
        kinds = {"seconds": float, "peak_memory": int}
        return {name: kind(noted[name]) for name, kind in kinds.items() if name in noted}
    except (ValueError, TypeError):
        raise OptionError(
            f"{note} must be a JSON object with the numbers seconds and peak_memory."
        ) from None


def _scored(row: BenchRow, splats: Splats, views: SceneViews, settings: BenchSettings) -> BenchRow:
    """The row with scores and frames a second; a failed one where scoring raises."""
    prepared = prepare(splats)
    scores: list[SetScore] = []
    notes = dict.fromkeys(row.notes)
    for label, some in views.sets.items():
        try:
            found = score(row.method, prepared, some, views.background, extras=settings.metrics)
        except NanogsError as error:
            return replace(row, status=Status.FAILED, reason=str(error))
        scores.append(_set_score(label, found))
        notes.update(dict.fromkeys(found.notes))
    first = {name.name: getattr(scores[0], name.name) for name in fields(SetScore)}
    row = replace(row, splats=len(splats), notes=tuple(notes), further=tuple(scores[1:]), **first)
    return _timed(row, splats, prepared, views)


def _set_score(label: str, found: ModelScore) -> SetScore:
    return SetScore(label, len(found.views), found.psnr, found.least_psnr, found.ssim, found.extras)


def _timed(row: BenchRow, splats: Splats, prepared: PreparedSplats, views: SceneViews) -> BenchRow:
    cameras = views.cameras[:_FPS_VIEWS]
    return replace(
        row,
        fps=frames_per_second(prepared, cameras),
        fps_gsplat=gsplat_fps(splats, cameras),
    )


def frames_per_second(prepared: PreparedSplats, cameras: Sequence[Camera]) -> float:
    """Frames a second of our renderer, one frame after the other, on warm kernels.

    Args:
        prepared: The model, activated beforehand as a viewer would do once.
        cameras: At least one.
    """
    render(prepared, cameras[0])
    start = time.perf_counter()
    for camera in cameras:
        render(prepared, camera)
    return len(cameras) / (time.perf_counter() - start)
