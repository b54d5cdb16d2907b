"""The text before the tables: how they were made, and what the columns mean."""

import os
import platform

from nanogs._version import __version__
from nanogs.bench.settings import BenchSettings
from nanogs.protocol import usual_views

_COLUMNS = """\
Every method runs in a process of its own. The columns:

- seconds: time of the method alone, with compiled kernels, without reading and writing; with file
  sizes, writing the files is part of it; for files of other tools the time that their producer
  noted, which may include both. Rows that were kept from an earlier run have the seconds and
  frames/s of that run.
- peak MB: largest resident memory of that process, including Python and its libraries; with file
  sizes also while files are written.
- bytes: size as .ply for methods that ran here at a ratio, otherwise size of the file.
- worst: PSNR of the worst view.
- frames/s: speed of the renderer of nanogs on the CPU.
"""


def preamble(settings: BenchSettings, command: str = "") -> str:
    """Return Markdown to put above the tables.

    Args:
        settings: The settings of the run.
        command: The command line of the run.
    """
    views = ", ".join(
        f"{settings.views or usual_views(kind)} {kind} of {size} x {size}"
        for kind in settings.kinds
        for size in settings.sizes
    )
    threads = settings.threads or "all"
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPUs, {threads} threads"
    lines = [f"```\n{command}\n```\n"] if command else []
    lines.append(f"nanogs {__version__}, Python {platform.python_version()}, {machine}.")
    lines.append(f"Views of scenes without photographs: {views}, which no method learns from.\n")
    if settings.render_mode is not None:
        lines.append(f"All models are drawn as {settings.render_mode}, whatever their files say.\n")
    return "\n".join([*lines, _COLUMNS]) + "\n"
