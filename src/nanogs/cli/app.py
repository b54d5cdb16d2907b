"""The Typer application: all commands of `nanogs`."""

import sys
from typing import Annotated

import typer

from nanogs._version import __version__
from nanogs.cli.bench import bench
from nanogs.cli.compare import compare
from nanogs.cli.convert import convert
from nanogs.cli.demo import demo
from nanogs.cli.examples import EXAMPLES
from nanogs.cli.help import Command, Group, examples_text
from nanogs.cli.info import info
from nanogs.cli.lod import lod
from nanogs.cli.presets import presets
from nanogs.cli.refit import refit
from nanogs.cli.render import render
from nanogs.cli.simplify import simplify
from nanogs.cli.studio import studio
from nanogs.cli.view import view
from nanogs.cli.warm import warm

app = typer.Typer(
    help="Make 3D Gaussian splatting models smaller: no training, no photographs, no GPU.",
    cls=Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        sys.stdout.write(f"nanogs {__version__}\n")
        raise typer.Exit


@app.callback()
def _nanogs(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    pass


for _command in (
    simplify, lod, refit, convert, info, presets, render, compare, view, studio, bench, demo,
    warm,
):  # fmt: skip
    _examples = examples_text(EXAMPLES[_command.__name__])
    app.command(cls=Command, epilog=_examples)(_command)
