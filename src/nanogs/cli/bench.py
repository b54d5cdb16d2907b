"""`nanogs bench`."""

import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nanogs.cli import options
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from nanogs.bench.output import ResultFolder
    from nanogs.bench.rows import BenchRow
    from nanogs.bench.scenes import BenchScene
    from nanogs.bench.settings import BenchSettings
    from nanogs.cli.progress import Watch


Models = Annotated[
    list[Path] | None, typer.Argument(metavar="[MODEL...]", help="Models to measure on.")
]
Scenes = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=MODEL[:FOLDER]",
        help="A model under a name, with the folder of its photographs and cameras.",
    ),
]
Datasets = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=FOLDER",
        help="A published data set, one folder a scene: nerf-synthetic, mip-nerf-360, "
        "tanks-and-temples or deep-blending.",
    ),
]
Pattern = Annotated[
    str | None,
    typer.Option(
        help="Where the trained models of data sets are.",
        show_default="{folder}/{scene}/point_cloud/iteration_30000/point_cloud.ply",
    ),
]
Methods = Annotated[
    str | None,
    typer.Option(
        help="Methods, with commas between; parameters of a preset as paper:tau=0:k=8.",
        show_default="all presets and baselines",
    ),
]
Externals = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=PATTERN",
        help="Files of another tool; {scene}, {model} (its file) and {ratio} are replaced.",
    ),
]
Cameras = Annotated[
    str,
    typer.Option(
        help="Where the views of scenes without photographs stand: auto, orbit, inside, roam; with "
        "commas between.",
        metavar="KINDS",
        rich_help_panel=options.VIEWS,
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Folder for results.md, results.jsonl and plot.svg; an unfinished run in it goes on.",
    ),
]


def bench(
    models: Models = None,
    scene: Scenes = None,
    dataset: Datasets = None,
    model_pattern: Pattern = None,
    ratios: Annotated[
        str, typer.Option(help="Compaction ratios, with commas between.", metavar="RATIOS")
    ] = "0.1,0.01,0.001",
    methods: Methods = None,
    external: Externals = None,
    ablations: Annotated[
        bool, typer.Option("--ablations", help="Also the published method without each part.")
    ] = False,
    metrics: Annotated[
        str, typer.Option(help="Further metrics: lpips, flip; with commas between.")
    ] = "",
    views: options.ViewsOfKinds = None,
    sizes: options.Sizes = "512",
    cameras: Cameras = "auto",
    up: options.Up = None,
    background: options.PhotoBackground = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of what methods draw.")] = 0,
    threads: options.Threads = None,
    out: Out = None,
    overwrite: options.Overwrite = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Measure methods against each other: quality, time, memory and speed, scene by scene."""
    from nanogs.bench.settings import BenchSettings

    settings = BenchSettings(
        ratios=tuple(options.parse_ratio(text) for text in _list(ratios)),
        methods=_methods(methods, ablations),
        externals=dict(_external(text) for text in external or []),
        views=views,
        sizes=tuple(map(_square, sizes.split(","))),
        kinds=tuple(_list(cameras)),
        background=None if background is None else options.parse_background(background),
        metrics=tuple(_list(metrics)),
        seed=seed,
        threads=threads,
    )
    scenes = _scenes(models or [], scene or [], dataset or [], model_pattern)
    scenes = [replace(one, up=up) for one in scenes]
    _show(scenes, settings, out, overwrite=overwrite, json=json, quiet=quiet)


def _methods(names: str | None, ablations: bool) -> tuple[str, ...]:
    from nanogs.bench.methods import ABLATIONS, all_methods

    chosen = _list(names) if names is not None else list(all_methods())
    if ablations:
        chosen += [name for name in ABLATIONS if name not in chosen]
    return tuple(chosen)


def _scenes(
    models: list[Path], named: list[str], datasets: list[str], pattern: str | None
) -> "list[BenchScene]":
    from nanogs.bench.scenes import TRAINED_MODEL, parse_dataset, parse_scene, scenes_of_files

    scenes = scenes_of_files(models)
    scenes += [parse_scene(text) for text in named]
    for text in datasets:
        scenes += parse_dataset(text, pattern or TRAINED_MODEL)
    return scenes


def _show(
    scenes: "list[BenchScene]",
    settings: "BenchSettings",
    out: Path | None,
    *,
    overwrite: bool,
    json: bool,
    quiet: bool,
) -> None:
    """Measure, and write the rows or the tables to stdout."""
    from nanogs.bench.preamble import preamble
    from nanogs.bench.tables import markdown
    from nanogs.cli.console import print_json

    above = preamble(settings, shlex.join(["nanogs", *sys.argv[1:]]))
    rows = _run(scenes, settings, out, overwrite, above, quiet or json)
    if json:
        print_json({"rows": [row.to_dict() for row in rows]})
    elif not quiet:
        typer.echo(above + markdown(rows), nl=False)


def _run(
    scenes: "list[BenchScene]",
    settings: "BenchSettings",
    out: Path | None,
    overwrite: bool,
    above: str,
    quiet: bool,
) -> "list[BenchRow]":
    """Measure, keep rows in the folder as they come, and show on stderr how it goes."""
    from nanogs.bench.output import ResultFolder, run_of
    from nanogs.bench.protocol import row_count, run_bench
    from nanogs.cli.progress import shown

    run = run_of(scenes, settings)
    folder = ResultFolder(out, run=run, overwrite=overwrite) if out else None
    done = folder.done if folder else []
    if done and not quiet:
        from nanogs.cli.console import warn
        from nanogs.formatting import counted

        taken = counted(len(done), "row is", "rows are")
        warn(f"{taken} taken from an unfinished run in {out}; -w begins anew.")
    with shown(quiet=quiet) as watch:
        observer = _Observer(watch, row_count(scenes, settings))
        rows = run_bench(
            scenes,
            settings,
            done=done,
            on_row=lambda row: observer.row(row, folder),
            progress=observer.stage,
        )
    if folder:
        folder.finish(rows, above)
    return rows


@dataclass(slots=True)
class _Observer:
    """A function that the library calls while it measures; each row is a stage."""

    watch: "Watch"
    total: int
    done: int = 0

    def stage(self, what: str) -> None:
        from nanogs.progress import Step

        number = min(self.done + 1, self.total)
        self.watch(Step(what, number, self.total, 0, 1, self.done / (self.total + 1)))

    def row(self, row: "BenchRow", folder: "ResultFolder | None") -> None:
        if folder:
            folder.add(row)
        if row.reason and not self.watch.quiet:
            from nanogs.cli.console import warn

            warn(f"{row.scene}, {row.method} at {row.ratio:g}: {row.status}: {row.reason}")
        self.done += 1


def _list(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _square(text: str) -> int:
    width, height = options.parse_pixels(text)
    if width != height:
        raise OptionError(f"The views to measure on are square: give one number, not {text!r}.")
    return width


def _external(text: str) -> tuple[str, str]:
    name, _, pattern = text.partition("=")
    if not name or not pattern:
        raise OptionError(f"An external result is NAME=PATTERN, not {text!r}.")
    return name, pattern
