"""The main loop: measure each method on each scene for each request, in a separate process."""

from collections.abc import Callable, Iterator, Mapping, Sequence

from nanogs.bench import measuring
from nanogs.bench.bjontegaard import check_packages
from nanogs.bench.rows import ORIGINAL, BenchRow, BenchTarget, RowKey
from nanogs.bench.scenes import BenchScene, scene_views
from nanogs.bench.settings import BenchSettings, refuse_duplicates
from nanogs.cleanup import temporary_folder
from nanogs.errors import NanogsError, OptionError
from nanogs.io import load
from nanogs.scoring.scores import check_metrics
from nanogs.source import source_of
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
    """Measure all rows; a result that cannot be measured gives a row with the reason.

    Args:
        scenes: The scenes; their names must differ.
        settings: What to measure.
        done: Rows of an earlier run, which are not measured again.
        on_row: Called with each row when it is complete.
        progress: Called with a description of the next step before it starts.

    Returns:
        Rows by scene, then request, then method. Each scene begins with the original model and,
        if file sizes are requested, with the whole model in each format.

    Raises:
        OptionError: There is no scene, two have the same name, or a setting is out of range.
    """
    if not scenes:
        raise OptionError("Give at least one model to measure on: a file, or a folder of models.")
    refuse_duplicates("scene", [scene.name for scene in scenes])
    for pattern in settings.externals.values():
        measuring.external_path(pattern, scenes[0], settings.targets[0])
    check_metrics(settings.metrics)
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


def row_count(scenes: Sequence[BenchScene], settings: BenchSettings) -> int:
    """Return the number of rows that `run_bench` will return."""
    return len(scenes) * len(row_keys(settings))


def row_keys(settings: BenchSettings) -> list[tuple[str, BenchTarget]]:
    """Return method and request of each row of a scene, in order; the same for all scenes."""
    names = [*settings.methods, *settings.externals]
    formats = settings.formats if settings.file_sizes else ()
    wholes = [(ORIGINAL, BenchTarget(1.0, suffix)) for suffix in ("", *formats)]
    return [*wholes, *((name, target) for target in settings.targets for name in names)]


def _scene_rows(
    scene: BenchScene, settings: BenchSettings, known: Mapping[RowKey, BenchRow], progress: Progress
) -> Iterator[BenchRow]:
    keys = [(scene.name, *run) for run in row_keys(settings)]
    if all(key in known for key in keys):
        yield from (known[key] for key in keys)
        return
    progress(f"{scene.name}: reading")
    try:
        splats = load(scene.model, render_mode=settings.render_mode)
        views = scene_views(scene, splats, settings)
    except NanogsError as error:
        for key in keys:
            yield known.get(key) or measuring.skipped_row(scene, key[1], key[2], str(error))
        return
    whole: dict[str, int] = {}  # bytes of the model in each format
    with temporary_folder("nanogs-bench-") as folder:
        for key in (key for key in keys if key[1] == ORIGINAL):
            target = key[2]
            progress(f"{scene.name}: {ORIGINAL} at {target.text}")
            row = known.get(key)
            if row is None and target.format:
                row = measuring.whole_row(scene, splats, target, views, settings, folder)
            row = row or measuring.original_row(scene, splats, views, settings)
            whole[target.format] = row.file_bytes or 0
            yield row
        original, finite = source_of(splats).columns, int(splats.finite().sum())
        del splats
        for key in (key for key in keys if key[1] != ORIGINAL):
            _, name, target = key
            progress(f"{scene.name}: {name} at {target.text}")
            if key in known:
                yield known[key]
            elif name not in settings.methods:
                yield measuring.external_row(scene, name, target, original, finite, views, settings)
            elif target.size is not None and 0 < whole[target.format] <= target.size:
                yield measuring.too_large_row(scene, name, target, whole[target.format])
            else:
                yield measuring.method_row(scene, name, target, views, settings, folder)
