"""Options for models that do not fit into the memory given; `in_blocks` acts on them."""

from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli import options

_PANEL = "Models larger than memory, and several machines"

MaxMemory = Annotated[
    int | None,
    typer.Option(
        parser=options.parse_memory,
        help="Memory that a process may take, e.g. 4GB: a model that needs more is simplified in"
        " blocks.",
        metavar="SIZE",
        rich_help_panel=_PANEL,
    ),
]
Join = Annotated[
    bool,
    typer.Option("--join", help="All inputs are parts of one scene.", rich_help_panel=_PANEL),
]
JobFolder = Annotated[
    Path | None,
    typer.Option(
        "--job",
        help="Folder for what survives a crash; removed at the end.",
        show_default="OUT.job",
        rich_help_panel=_PANEL,
    ),
]
Resume = Annotated[
    bool,
    typer.Option("--resume", help="Continue the job in that folder.", rich_help_panel=_PANEL),
]
Scratch = Annotated[
    str | None,
    typer.Option(
        help="Folder or URL of the intermediate files, which all workers see.",
        show_default="in the job folder",
        rich_help_panel=_PANEL,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(min=1, help="Processes on this machine.", rich_help_panel=_PANEL),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Dask scheduler whose workers do the work, e.g. tcp://host:8786.",
        rich_help_panel=_PANEL,
    ),
]
Patience = Annotated[
    float,
    typer.Option(
        min=0,
        help="Seconds to wait for workers where a scheduler has none.",
        metavar="SECONDS",
        rich_help_panel=_PANEL,
    ),
]
