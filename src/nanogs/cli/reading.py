"""Reading a model to be simplified: parts are joined, splats and bands left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from nanogs.cli.file_options import Edits
from nanogs.cli.filtering import parse_filters
from nanogs.clock import StageClock
from nanogs.errors import OptionError
from nanogs.filters import Filter, FilterReport, apply
from nanogs.io import FileInfo, inspect, load
from nanogs.io import open as open_model
from nanogs.pipeline.weights import read_weight
from nanogs.progress import Stage, Tracker
from nanogs.source import Joined
from nanogs.splats import MAX_SH_DEGREE, Splats


@dataclass(frozen=True, slots=True)
class Prepared:
    """A model as it is simplified.

    Attributes:
        splats: The model.
        took: What each filter took.
        notes: What else the user should know, one sentence each.
    """

    splats: Splats
    took: tuple[FilterReport, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Reading:
    """Changes to a model before it is simplified.

    Attributes:
        filters: To apply first.
        sh_degree: The highest that stays, or None for all.
    """

    filters: Sequence[Filter] = ()
    sh_degree: int | None = None

    def stages(self, splats: int) -> list[Stage]:
        """The stages of `load`."""
        read = [Stage("read", read_weight(splats))]
        return [*read, Stage("filter", read_weight(splats))] if self.filters else read

    def load(self, paths: Sequence[Path], progress: Tracker, clock: StageClock) -> Prepared:
        """Read a model of one or several files, and prepare it.

        Raises:
            NanogsError: A file cannot be read, or a filter leaves nothing.
        """
        progress.begin("read")
        with clock.time("read"):
            splats = read_parts(paths)
        if not self.filters:
            return self.prepare(splats)
        progress.begin("filter")
        with clock.time("filter"):
            return self.prepare(splats)

    def prepare(self, splats: Splats) -> Prepared:
        """Leave out what is not wanted.

        Raises:
            ModelError: A filter leaves nothing.
        """
        left, took = apply(splats, self.filters)
        if self.sh_degree is None or self.sh_degree >= left.sh_degree:
            return Prepared(left, took, ())
        note = (
            f"Spherical harmonics above degree {self.sh_degree} were dropped first; PSNR is against"
            " the model without them."
        )
        return Prepared(left.with_sh_degree(self.sh_degree), took, (note,))


def inspect_parts(paths: Sequence[Path]) -> FileInfo:
    """The first file's description, with the splats and bytes of all.

    Raises:
        FormatError: A file cannot be read.
    """
    infos = [inspect(path) for path in paths]
    return replace(
        infos[0],
        splats=sum(info.splats for info in infos),
        file_bytes=sum(info.file_bytes for info in infos),
        sh_degree=max(info.sh_degree for info in infos),
    )


def parse_reading(edits: Edits, psnr: float | None = None) -> Reading:
    """Make the changes that the options ask for.

    Raises:
        OptionError: One of them makes no sense, or a PSNR would be of another model.
    """
    degree = edits.sh_degree
    if degree is not None and not 0 <= degree <= MAX_SH_DEGREE:
        raise OptionError(f"--sh-degree is from 0 to {MAX_SH_DEGREE}, not {degree}.")
    if degree is not None and psnr is not None:
        raise OptionError(
            "--psnr is against the whole model, of which --sh-degree leaves out some; run"
            " `nanogs convert --sh-degree` first."
        )
    return Reading(parse_filters(edits), degree)


def read_parts(paths: Sequence[Path]) -> Splats:
    """The model of one file, or of several that are its parts.

    Raises:
        NanogsError: A file cannot be read, or they do not go together.
    """
    if len(paths) == 1:
        return load(paths[0])
    with Joined([open_model(path) for path in paths]) as source:
        return source.load()
