"""Options for models larger than memory, which are simplified in blocks; used by `plan`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from nanogs.cli import options, parsing
from nanogs.defaults import PATIENCE
from nanogs.errors import OptionError

DASH = Path("-")
"""The path that means stdin or stdout."""
_option = options.in_panel("Models larger than memory, and several machines")


@dataclass(frozen=True, slots=True, kw_only=True)
class Blocks:
    """Options for models that do not fit in memory."""

    max_memory: Annotated[
        int | None,
        _option(
            "Memory that each process may use, e.g. 4GB; a model that needs more is simplified in"
            " blocks.",
            parser=parsing.parse_memory,
            metavar="SIZE",
        ),
    ] = None
    join: Annotated[bool, _option("Treat all inputs as parts of one scene.", "--join")] = False
    job: Annotated[
        Path | None,
        _option(
            "Folder for intermediate results, which survive a crash; removed at the end.",
            parser=parsing.parse_local,
            metavar="FOLDER",
            show_default="OUT.job",
        ),
    ] = None
    resume: Annotated[bool, _option("Continue the unfinished job in that folder.", "--resume")] = (
        False
    )
    scratch: Annotated[
        str | None,
        _option(
            "Folder or URL for the intermediate files, which all workers must be able to read and"
            " write.",
            show_default="in the job folder",
        ),
    ] = None
    workers: Annotated[
        int | None,
        _option("Number of processes on this machine.", min=1, max=options.MOST_PROCESSES),
    ] = None
    scheduler: Annotated[
        str | None,
        _option("Dask scheduler whose workers do the work, e.g. tcp://host:8786."),
    ] = None
    patience: Annotated[
        float | None,
        _option(
            "Seconds to wait for workers if the scheduler has none.",
            min=0,
            metavar="SECONDS",
            show_default=f"{PATIENCE:g}",
        ),
    ] = None

    def check(self, paths: Sequence[Path]) -> None:
        """Refuse combinations of options and paths that are invalid whatever the files hold.

        Raises:
            OptionError: An option is empty, or options contradict each other or the paths.
        """
        for option, given in {"--scratch": self.scratch, "--scheduler": self.scheduler}.items():
            if given is not None and not given.strip():
                raise OptionError(f"{option} is empty; name a place after it, or leave it out.")
        if self.workers is not None and self.scheduler is not None:
            raise OptionError("Give --workers or --scheduler, not both.")
        if (self.max_memory is not None or self.join) and DASH in paths:
            raise OptionError(
                "--max-memory and --join do not work with pipes; name files in place of -."
            )
        _refuse_addresses(paths, self._needing_files)
        if self.join and len(paths) < 2:
            raise OptionError(
                "--join needs the parts of a scene and OUT, but only one path was given; name the"
                " others too."
            )

    @property
    def _needing_files(self) -> list[str]:
        """Given options that need files, because models are read again later or elsewhere."""
        named: dict[str, object] = {"--join": self.join, "--job": self.job, "--resume": self.resume}
        named["--scheduler"] = self.scheduler
        return [option for option, given in named.items() if given]

    @property
    def dividing(self) -> str:
        """The first given option that makes blocks of any model, large or not; "" if none is."""
        named = {"--job": self.job, "--resume": self.resume, "--scratch": self.scratch}
        return next((option for option, given in named.items() if given), "")

    def unused(self, *, divided: bool) -> list[str]:
        """Return notes on options that have no effect.

        Args:
            divided: Whether the model is simplified in blocks.
        """
        notes = []
        if self.patience is not None and self.scheduler is None:
            notes = ["--patience had no effect, because it needs a --scheduler, which is missing."]
        if not divided:
            notes += self._unused_in_memory()
        return notes

    def _unused_in_memory(self) -> list[str]:
        named: dict[str, object] = {"--workers": self.workers, "--scheduler": self.scheduler}
        found = " and ".join(option for option, value in named.items() if value)
        if not found:
            return []
        if self.max_memory is not None:
            why = "the model fits into --max-memory and needs no blocks"
            return [f"{found} had no effect, because {why}."]
        note = (
            f"{found} had no effect, because the model fits into memory and is not simplified in"
            " blocks; --max-memory sets a limit for each process and so makes blocks."
        )
        return [note]


def _refuse_addresses(paths: Sequence[Path], options: Sequence[str]) -> None:
    """Refuse URLs if options that need files are given.

    Raises:
        OptionError: A path is a URL, and there are such options.
    """
    from nanogs.io.url_files import refuse_address  # here because `--help` does not need it

    for path in paths if options else ():
        refuse_address(path, f"{options[0]} needs files: download it first")
