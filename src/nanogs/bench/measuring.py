"""Measuring one row: make or load one result, and score it."""

import json
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nanogs.bench.gsplat import gsplat_fps
from nanogs.bench.rows import ORIGINAL, Against, BenchRow, BenchTarget, SetScore, Status, size_name
from nanogs.bench.scenes import BenchScene, SceneViews, fill, scene_of_file
from nanogs.bench.settings import BenchSettings
from nanogs.bench.worker import Job, run_job
from nanogs.errors import NanogsError, OptionError
from nanogs.formatting import counted
from nanogs.io import inspect, load, save
from nanogs.io import open as open_model
from nanogs.io.frames import other_frames
from nanogs.pipeline.options.target import target_count
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import PreparedSplats, prepare, render
from nanogs.scoring.comparison import layout_notes
from nanogs.scoring.scores import ModelScore, score
from nanogs.source import Layout, source_of
from nanogs.splats import Splats

_FPS_VIEWS = 8  # most views rendered to measure frames per second


def empty_row(scene: BenchScene, method: str, target: BenchTarget) -> BenchRow:
    """Return a row that holds only the request, without a result."""
    against = Against.ORIGINAL if scene.photos is None else Against.PHOTOGRAPHS
    return BenchRow(
        scene.name, method, target.ratio, against=against, dataset=scene.dataset,
        format=target.format, size=target.size,
    )  # fmt: skip


def skipped_row(scene: BenchScene, method: str, target: BenchTarget, reason: str) -> BenchRow:
    """Return a row of which there is nothing to measure, for the reason."""
    return replace(empty_row(scene, method, target), status=Status.SKIPPED, reason=reason)


def too_large_row(scene: BenchScene, method: str, target: BenchTarget, whole: int) -> BenchRow:
    """Return a skipped row: the requested size is so large that the whole model fits into it."""
    reason = f"The whole model as {target.format} takes {whole:,} B, which fits into this size."
    return skipped_row(scene, method, target, reason)


def original_row(
    scene: BenchScene, splats: Splats, views: SceneViews, settings: BenchSettings
) -> BenchRow:
    """Measure the original model: its score against photographs, or else only its frame rate."""
    row = replace(
        empty_row(scene, ORIGINAL, BenchTarget(1.0)),
        splats=len(splats),
        file_bytes=inspect(scene.model).file_bytes,
        label=next(iter(views.sets)),
        views=views.count,
        notes=(*views.notes, *splats.notes),
    )
    if views.against is Against.PHOTOGRAPHS:
        return _scored(row, splats, views, settings)
    # Against itself the PSNR would be infinite; only the frame rate is of interest.
    return _timed(row, splats, prepare(splats), views)


def whole_row(
    scene: BenchScene,
    splats: Splats,
    target: BenchTarget,
    views: SceneViews,
    settings: BenchSettings,
    folder: Path,
) -> BenchRow:
    """Score the whole model written in a format, which shows the loss of the format alone."""
    row, path = empty_row(scene, ORIGINAL, target), folder / f"whole{target.format}"
    try:
        left_out = save(splats, path)
        decoded = load(path, render_mode=settings.render_mode)
    except NanogsError as error:
        return replace(row, status=Status.FAILED, reason=str(error))
    notes = (*left_out, *decoded.notes)
    row = replace(row, file_bytes=path.stat().st_size, notes=notes)
    path.unlink()
    return _scored(row, decoded, views, settings)


def method_row(
    scene: BenchScene,
    method: str,
    target: BenchTarget,
    views: SceneViews,
    settings: BenchSettings,
    folder: Path,
) -> BenchRow:
    """Run a preset or baseline in a separate process, and score its result."""
    row = empty_row(scene, method, target)
    # A folder of its own: a process that was killed leaves the files of its job there.
    with TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as own:
        output = Path(own) / f"result{target.format or '.ply'}"
        job = Job(
            scene.model, method, target.ratio or 1.0, output, views.fit_cameras, views.trained,
            settings.seed, settings.threads, target.size, settings.render_mode,
        )  # fmt: skip
        outcome = run_job(job)
        if outcome.error:
            return replace(row, status=Status.FAILED, reason=outcome.error)
        size, splats = output.stat().st_size, load(output, render_mode=settings.render_mode)
    row = replace(
        row,
        file_bytes=size,
        seconds=outcome.seconds,
        read_seconds=outcome.read_seconds,
        peak_memory=outcome.peak_memory,
        notes=(*_count_note(outcome.splats, outcome.asked), *outcome.notes),
    )
    return _scored(row, splats, views, settings)


def external_row(
    scene: BenchScene,
    name: str,
    target: BenchTarget,
    original: Layout,
    finite: int,
    views: SceneViews,
    settings: BenchSettings,
) -> BenchRow:
    """Score another tool's file.

    Args:
        scene: The scene.
        name: The other tool's name.
        target: The request.
        original: The layout of the original model.
        finite: Number of its finite splats.
        views: What is compared with.
        settings: The settings of the run.
    """
    path = external_path(settings.externals[name], scene, target)
    if not path.exists():
        return skipped_row(scene, name, target, f"There is no file {path}.")
    row = empty_row(scene, name, target)
    try:
        with open_model(scene.model) as whole, open_model(path) as file:
            frames = other_frames([(each.name, each) for each in (whole, file)])
            row = replace(row, file_bytes=file.info.file_bytes, **_producer_figures(path))
        splats = load(path, render_mode=settings.render_mode)
    except NanogsError as error:
        return replace(row, status=Status.FAILED, reason=str(error))
    if target.size is not None:
        notes = _size_note(row.file_bytes or 0, target.size)
    else:
        notes = _count_note(len(splats), target_count(finite, target.ratio, None))
    notes += (*frames, *layout_notes(source_of(splats).columns, original, "the original"))
    return _scored(replace(row, notes=(*notes, *splats.notes)), splats, views, settings)


def external_path(pattern: str, scene: BenchScene, target: BenchTarget) -> Path:
    """Return the path of another tool's file for a scene and request.

    Raises:
        OptionError: The pattern has an unknown placeholder.
    """
    named = {"scene": scene.name, "model": scene_of_file(scene.model).name}
    if target.size is None:
        named["ratio"] = f"{target.ratio:g}"
    else:
        named |= {"size": size_name(target.size), "format": target.format.lstrip(".")}
    return Path(fill(pattern, **named))


def note_of(path: Path) -> Path:
    """Return the path of the JSON file in which another tool's file has its seconds and memory."""
    return path.with_name(path.name + ".json")


def _size_note(taken: int, size: int) -> tuple[str, ...]:
    if taken <= size:
        return ()
    return (f"{taken:,} B, above the {size:,} B asked for",)


def _count_note(delivered: int, asked: int) -> tuple[str, ...]:
    if delivered == asked:
        return ()
    return (f"{counted(delivered, 'splat')} instead of the {asked:,} asked for",)


def _producer_figures(path: Path) -> dict[str, Any]:
    """Read the seconds and peak memory that the file's producer noted in a JSON file beside it.

    Raises:
        OptionError: The note is not a JSON object of numbers.
    """
    note = note_of(path)
    if not note.exists():
        return {}
    try:
        noted = dict(json.loads(note.read_text(encoding="utf-8-sig")))
        kinds = {"seconds": float, "peak_memory": int}
        return {name: kind(noted[name]) for name, kind in kinds.items() if name in noted}
    except (ValueError, TypeError, OverflowError):
        raise OptionError(
            f"{note} must be a JSON object with the numbers seconds and peak_memory."
        ) from None


def _scored(row: BenchRow, splats: Splats, views: SceneViews, settings: BenchSettings) -> BenchRow:
    """Add scores and frames per second to the row; if scoring raises, return a failed row."""
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
    """Measure the frames per second of our renderer, in sequence, kernels compiled beforehand.

    Args:
        prepared: The model, prepared beforehand as a viewer would do once.
        cameras: At least one.
    """
    render(prepared, cameras[0])
    start = time.perf_counter()
    for camera in cameras:
        render(prepared, camera)
    return len(cameras) / (time.perf_counter() - start)
