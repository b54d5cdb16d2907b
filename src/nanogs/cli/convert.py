"""`nanogs convert`."""

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nanogs.cli import file_options, options, parsing
from nanogs.cli.groups import with_options
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from nanogs.cli.many import Run
    from nanogs.conversion import ConvertReport
    from nanogs.io.collect import Pair
    from nanogs.progress import Progress


_NONE = parsing.Vector(0.0, 0.0, 0.0)
_transform = partial(
    typer.Option,
    rich_help_panel="Transforms (after --frame, in this order, in the frame of OUT)",
    show_default=False,
)


def _vector(option: str, about: str) -> Any:  # noqa: ANN401 - as typer has it
    return _transform(
        option,
        parser=lambda given: parsing.parse_vector(given, option),
        metavar="X,Y,Z",
        help=about,
    )


@with_options
def convert(
    *,
    paths: file_options.Paths,
    level: options.Level = 0,
    turn: Annotated[
        bool,
        typer.Option(
            "--turn",
            help="Turn by 180 degrees about x: from y up (SPZ by its specification) to y down"
            " (3DGS), or back. The same as --frame rub:rdf.",
        ),
    ] = False,
    scale: Annotated[
        float,
        _transform(
            help="Scale the model about the origin by this factor.",
            metavar="FACTOR",
        ),
    ] = 1.0,
    rotate: Annotated[
        parsing.Vector,
        _vector(
            "--rotate",
            "Turn it about the axes through the origin, x first, then y, then z; degrees.",
        ),
    ] = _NONE,
    translate: Annotated[
        parsing.Vector,
        _vector("--translate", "Move it, in scene units of OUT."),
    ] = _NONE,
    of_format: options.OfFormat,
    overwrite: options.Overwrite = False,
    max_memory: options.MaxMemory = None,
    reporting: options.Reporting,
    files: file_options.Files,
    edits: file_options.Edits,
) -> None:
    """Write a model in another format; the suffixes of the names say which."""
    # Imported here because `--help` does not need it.
    from nanogs.cli import filtering, framing, many
    from nanogs.conversion import convert as library_convert

    if turn and edits.frame:
        raise OptionError("--turn and --frame both turn the model; give one of them.")
    filters = filtering.parse_filters(edits)

    def run_one(pair: "Pair", progress: "Progress") -> "Run":
        source, target = pair.source, pair.target
        frame = framing.turned(source) if turn else framing.frames_of([source], target, edits.frame)
        report = library_convert(
            source, target, level=level, filters=filters, sh_degree=edits.sh_degree,
            frame=frame, scale=scale, rotate=rotate, translate=translate,
            render_mode=edits.render_mode, overwrite=overwrite,
            format_options=of_format, max_memory=max_memory, progress=progress,
        )  # fmt: skip
        return many.Run(report, {"input": report.input, "output": report.output})

    pairs = many.plan_pairs(paths, files)
    many.run_all(pairs, run_one, _print_report, reporting, files, overwrite=overwrite)


def _print_report(run: "Run") -> None:
    """Print the result of a conversion, and the losses, on stderr."""
    from nanogs.cli.console import arrow, say, warn
    from nanogs.cli.filtering import report_filters
    from nanogs.formatting import counted, sizes_text, time_text

    report: ConvertReport = run.report
    report_filters(report.filters)
    for note in (*report.notes, *report.losses):
        warn(note)
    what = f"{counted(report.splats, 'splat')} of SH degree {report.sh_degree}"
    sizes = sizes_text(report.input_bytes, report.output_bytes, arrow())
    say(f"{what} in {run.files['output']}, {sizes}, {time_text(report.total_seconds)}")
