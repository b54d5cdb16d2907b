"""Options for models larger than memory, which are simplified in blocks; used by `plan`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from nanogs.cli import options
from nanogs.defaults import PATIENCE
from nanogs.errors import OptionError

DASH = Path("-")
"""Stands for stdin or stdout."""
_option = options.in_panel("Models larger than memory, and several machines")


@dataclass(frozen=True, slots=True, kw_only=True)
class Blocks:
    """Options for models that do not fit in memory."""

    max_memory: Annotated[
        int | None,
        _option(
            "Memory that a process may take, e.g. 4GB: a model that needs more is simplified in"
            " blocks.",
            parser=options.parse_memory,
            metavar="SIZE",
        ),
    ] = None
    join: Annotated[bool, _option("All inputs are parts of one scene.", "--join")] = False
    job: Annotated[
        Path | None,
        _option("Folder for what survives a crash; removed at the end.", show_default="OUT.job"),
    ] = None
    resume: Annotated[bool, _option("Continue the job in that folder.", "--resume")] = False
    scratch: Annotated[
        str | None,
        _option(
            "Folder or URL of the intermediate files, which all workers see.",
            show_default="in the job folder",
        ),
    ] = None
    workers: Annotated[int | None, _option("Processes on this machine.", min=1)] = None
    scheduler: Annotated[
        str | None,
        _option("Dask scheduler whose workers do the work, e.g. tcp://host:8786."),
    ] = None
    patience: Annotated[
        float,
        _option(
            "Seconds to wait for workers where a scheduler has none.", min=0, metavar="SECONDS"
        ),
    ] = PATIENCE

    def check(self, paths: Sequence[Path]) -> None:
        """Refuse combinations of options and paths that are invalid whatever the files hold.

        Raises:
            OptionError: Options contradict each other or the paths.
        """
        if self.workers is not None and self.scheduler is not None:
            raise OptionError("Give --workers or --scheduler, not both.")
        if (self.max_memory is not None or self.join) and DASH in paths:
            raise OptionError(
                "With --max-memory or --join models are files; name them in place of -."
            )
        _refuse_addresses(paths, self._needing_files)
        if self.join and len(paths) < 2:
            raise OptionError("--join takes the parts of a scene and OUT; this is one path.")

    @property
    def _needing_files(self) -> list[str]:
        """Given options that need files, because models are read again later or elsewhere."""
        named: dict[str, object] = {"--join": self.join, "--job": self.job, "--resume": self.resume}
        named["--scheduler"] = self.scheduler
        return [option for option, given in named.items() if given]

    def unused(self) -> list[str]:
        """Return a note on options for blocks, which have no effect if the model fits in memory."""
        named: dict[str, object] = {"--workers": self.workers, "--scheduler": self.scheduler}
        found = " and ".join(option for option, value in named.items() if value)
        if not found:
            return []
        if self.max_memory is not None:
            return [f"The model fits into --max-memory and needs no blocks: {found} had no effect."]
        note = (
            "The model fits into memory, so it is simplified in one process and not in blocks:"
            f" {found} had no effect; --max-memory makes blocks."
        )
        return [note]


def _refuse_addresses(paths: Sequence[Path], options: Sequence[str]) -> None:
    """Refuse URLs if options that need files are given.

    Raises:
        OptionError: A path is a URL, and there are such options.
    """
    from nanogs.io.url_files import refuse_address  # here because `--help` does not need it

    for path in paths if options else ():
        refuse_address(path, f"with {options[0]} models are files: download it first")
