"""`nanogs bench`."""

import shlex
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nanogs.cli import options, parsing
from nanogs.cli.groups import with_options
from nanogs.defaults import BENCH_RATIOS
from nanogs.errors import NanogsError, OptionError
from nanogs.protocol import PIXELS

if TYPE_CHECKING:
    from nanogs.bench.rows import BenchRow
    from nanogs.bench.scenes import BenchScene
    from nanogs.bench.settings import BenchSettings


@with_options
def bench(
    *,
    models: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[MODEL...]",
            parser=parsing.parse_model,
            help="Models to measure on: files, or folders of models.",
        ),
    ] = None,
    scene: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=MODEL[:FOLDER]",
            help="A model under a name, with the folder of its photographs and cameras.",
        ),
    ] = None,
    dataset: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FOLDER",
            help="A published data set in a folder with one subfolder per scene; NAME is"
            " nerf-synthetic, mip-nerf-360, tanks-and-temples or deep-blending.",
        ),
    ] = None,
    model_pattern: Annotated[
        str | None,
        typer.Option(
            help="Path of the trained model of each scene of a data set, in which {folder} and"
            " {scene} are replaced.",
            show_default="where the reference trainer writes it after 30,000 iterations",
        ),
    ] = None,
    ratios: Annotated[
        str | None,
        typer.Option(
            help="Compaction ratios, separated by commas.",
            metavar="RATIOS",
            show_default=",".join(map(str, BENCH_RATIOS)),
        ),
    ] = None,
    sizes_of_files: Annotated[
        str | None,
        typer.Option(
            help="Sizes of files, like 0.5MB,1MB, in place of ratios. Presets fill each size as"
            " `simplify --size` does, and the decoded file is measured.",
            metavar="SIZES",
        ),
    ] = None,
    formats: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Formats of these files, separated by commas, e.g. sog,spz.",
            metavar="FORMATS",
            show_default="sog",
        ),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help="Methods, separated by commas; parameters of a preset are added as in"
            " paper:tau=0:k=8.",
            show_default="all presets and baselines; with --sizes-of-files fast, default and best",
        ),
    ] = None,
    external: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=PATTERN",
            help="Files made by another tool; {scene} (its name), {model} (the model's file name up"
            " to the first dot) and {ratio}, or {size} (like 0.5MB) and {format}, are replaced in"
            " PATTERN.",
        ),
    ] = None,
    ablations: Annotated[
        bool,
        typer.Option(
            "--ablations", help="Also measure paper, default and fast without each of their parts."
        ),
    ] = False,
    metrics: Annotated[
        str | None, typer.Option(help="Further metrics, separated by commas: lpips, flip.")
    ] = None,
    views: options.ViewsOfKinds = None,
    sizes: options.Sizes = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            help="Automatic views for scenes without photographs: auto, orbit, inside, roam;"
            " several are separated by commas.",
            parser=parsing.parse_cameras,
            metavar="KINDS",
            rich_help_panel=options.VIEWS,
            show_default="auto; with --sizes-of-files auto,roam",
        ),
    ] = None,
    up: options.Up = None,
    background: options.PhotoBackground = None,
    render_mode: options.AsMode = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the random numbers that methods use.")
    ] = 0,
    threads: options.Threads = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            parser=parsing.parse_local,
            metavar="FOLDER",
            help="Folder for results.md, results.jsonl and plot.svg, with --sizes-of-files also"
            " results.html and plot.png; an unfinished run in it is continued, and further methods"
            " are added to a finished one.",
        ),
    ] = None,
    overwrite: options.Overwrite = False,
    reporting: options.Reporting,
) -> None:
    """Measure methods against each other: quality, time, memory and speed, scene by scene."""
    from nanogs.bench import scenes as known
    from nanogs.bench.gains import mean_gains
    from nanogs.bench.methods import ABLATIONS
    from nanogs.bench.output import only_run_in
    from nanogs.bench.preamble import preamble
    from nanogs.bench.settings import BenchSettings
    from nanogs.bench.tables import markdown
    from nanogs.formatting import plain

    targets = _targets(ratios, sizes_of_files, formats)
    chosen = _usual_methods(targets) if methods is None else parsing.parse_list(methods)
    chosen += [name for name in ABLATIONS if ablations and name not in chosen]
    kinds = cameras or ("auto,roam" if sizes_of_files is not None else "auto")
    settings = BenchSettings(
        **targets,
        methods=tuple(chosen),
        externals=_externals(external or []),
        views=views,
        sizes=tuple(map(_square, parsing.parse_sizes(str(PIXELS) if sizes is None else sizes))),
        kinds=tuple(parsing.parse_list(kinds)),
        background=None if background is None else parsing.parse_background(background),
        metrics=tuple(parsing.parse_metrics(metrics)),
        seed=seed,
        threads=threads,
        render_mode=render_mode,
    )
    scenes = known.scenes_of_files(models or [])
    scenes += [known.parse_scene(text) for text in scene or []]
    for text in dataset or []:
        scenes += known.parse_dataset(
            text, known.TRAINED_MODEL if model_pattern is None else model_pattern
        )
    scenes = [replace(one, up=up) for one in scenes]
    _refuse_unused(scenes, dataset, model_pattern, views, background)
    _refuse_unused_views(scenes, {"--sizes": sizes, "--cameras": cameras, "--up": up})
    above = preamble(settings, shlex.join(["nanogs", *sys.argv[1:]]))
    with only_run_in(out) if out else nullcontext():
        rows = _run(scenes, settings, out, overwrite, above, reporting)
    data: dict[str, Any] = {"rows": [row.to_dict() for row in rows]}
    others = tuple(settings.externals)
    if settings.file_sizes:
        data["gains"] = [plain(gain) for gain in mean_gains(rows, others)]
    reporting.report(data, lambda: typer.echo(above + markdown(rows, others=others), nl=False))
    _exit_if_failed(rows)


def _exit_if_failed(rows: "list[BenchRow]") -> None:
    """Say that nothing was measured, or which result failed first, and exit.

    Raises:
        typer.Exit: With code 2 if nothing was measured, with 3 if a method failed.
    """
    from nanogs.bench.rows import Status
    from nanogs.cli.console import fail
    from nanogs.formatting import counted

    if not any(row.measured for row in rows):
        first = next(row for row in rows if row.reason)
        fail(f"Nothing was measured; {first.scene}: {first.reason}")
        raise typer.Exit(2)
    if failed := [row for row in rows if row.status is Status.FAILED]:
        first, number = failed[0], counted(len(failed), "result")
        where = f"{first.method} for {first.scene} at {first.target.text}"
        fail(f"{number} failed, first that of {where}: {first.reason}")
        raise typer.Exit(3)


def _run(
    scenes: "list[BenchScene]",
    settings: "BenchSettings",
    out: Path | None,
    overwrite: bool,
    above: str,
    reporting: options.Reporting,
) -> "list[BenchRow]":
    """Measure all rows, save each to the output folder, and show the progress on stderr."""
    from nanogs.bench.output import ResultFolder, run_of
    from nanogs.bench.run import row_count, run_bench
    from nanogs.cli.console import warn
    from nanogs.cli.progress import shown
    from nanogs.formatting import counted
    from nanogs.progress import Step

    folder = ResultFolder(out, run=run_of(scenes, settings), overwrite=overwrite) if out else None
    done = folder.done if folder else []
    if done and not reporting.hushed:
        taken = counted(len(done), "row is", "rows are")
        warn(f"{taken} taken from an earlier run in {out}; -w starts from the beginning.")
    total, made = row_count(scenes, settings), 0
    with shown(quiet=reporting.hushed) as watch:

        def on_row(row: "BenchRow") -> None:
            nonlocal made
            made += 1
            if folder:
                folder.add(row)
            if row.reason and not reporting.hushed:
                warn(f"{row.scene}, {row.method} at {row.target.text}: {row.status}: {row.reason}")

        def on_stage(what: str) -> None:
            watch(Step(what, min(made + 1, total), total, 0, 1, made / (total + 1)))

        try:
            rows = run_bench(scenes, settings, done=done, on_row=on_row, progress=on_stage)
        except NanogsError:
            if folder and not made:
                folder.abandon()
            raise
    if folder and any(row.measured for row in rows):
        folder.finish(rows, above, tuple(settings.externals))
    elif folder:
        folder.abandon()
    return rows


def _targets(ratios: str | None, sizes: str | None, formats: str | None) -> dict[str, Any]:
    """Parse the requests to every method into fields of the settings: ratios, or file sizes."""
    from nanogs.io.registry import suffix_of
    from nanogs.quantities import parse_bytes

    if sizes is None:
        if formats is not None:
            raise OptionError(
                "--format works only with --sizes-of-files; give sizes too, or leave it out."
            )
        if ratios is None:
            return {"ratios": BENCH_RATIOS}
        texts = parsing.parse_list(ratios)
        return {"ratios": tuple(parsing.parse_ratio(text, "--ratios") for text in texts)}
    if ratios is not None:
        raise OptionError("Give --ratios or --sizes-of-files, not both.")
    if not parsing.parse_list(sizes):
        raise OptionError("--sizes-of-files needs at least one size, like 0.5MB,1MB.")
    chosen = tuple(
        suffix_of(name) for name in parsing.parse_list("sog" if formats is None else formats)
    )
    if not chosen:
        raise OptionError("--format needs at least one format, like sog,spz.")
    return {"file_sizes": tuple(map(parse_bytes, parsing.parse_list(sizes))), "formats": chosen}


def _refuse_unused(
    scenes: "list[BenchScene]",
    dataset: list[str] | None,
    model_pattern: str | None,
    views: int | None,
    background: str | None,
) -> None:
    """Refuse options that no scene uses."""
    if model_pattern is not None and not dataset:
        raise OptionError("--model-pattern works only with --dataset; give both, or leave it out.")
    if background is not None and not any(scene.photos for scene in scenes):
        raise OptionError(
            "--background has no effect, because no scene has photographs; name their folder, as in"
            " --scene NAME=MODEL:FOLDER, or leave it out."
        )
    if views is not None and scenes and all(scene.photos for scene in scenes):
        raise OptionError(
            "--views has no effect, because all scenes have photographs, each of which is a view;"
            " leave it out."
        )


def _refuse_unused_views(scenes: "list[BenchScene]", given: dict[str, Any]) -> None:
    """Refuse options of automatic views if none are made, not even for methods to learn from."""
    from nanogs.bench.scenes import takes_automatic_views

    unused = [name for name, value in given.items() if value is not None]
    if unused and scenes and not any(map(takes_automatic_views, scenes)):
        raise OptionError(
            f"{unused[0]} has no effect, because all scenes have photographs to measure on and to"
            " learn from; leave it out."
        )


def _usual_methods(targets: dict[str, Any]) -> list[str]:
    from nanogs.bench.methods import all_methods, sized_methods

    return list(sized_methods(targets["formats"]) if "formats" in targets else all_methods())


def _square(size: tuple[int, int]) -> int:
    width, height = size
    if width != height:
        raise OptionError(
            f"The views to measure on are square: give one number, not {width}x{height}."
        )
    return width


def _externals(texts: list[str]) -> dict[str, str]:
    from nanogs.bench.settings import refuse_duplicates

    pairs = [_external(text) for text in texts]
    refuse_duplicates("external result", [name for name, _ in pairs])
    return dict(pairs)


def _external(text: str) -> tuple[str, str]:
    name, _, pattern = text.partition("=")
    if not name or not pattern:
        raise OptionError(f"An external result is NAME=PATTERN, not {text!r}.")
    return name, pattern
