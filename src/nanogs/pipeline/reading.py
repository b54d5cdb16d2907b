"""Reading a model to be simplified: its parts are joined, unwanted splats and bands left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from nanogs.clock import StageClock
from nanogs.errors import OptionError
from nanogs.filters import Filter, FilterReport, apply, refuse_whole
from nanogs.io import FileInfo, inspect, load
from nanogs.io import open as open_model
from nanogs.io.parts import FileSource
from nanogs.pipeline.estimates.stage_weights import read_weight
from nanogs.progress import Stage, Tracker
from nanogs.source import Joined
from nanogs.splats import RenderMode, Splats


@dataclass(frozen=True, slots=True)
class Changes:
    """Changes to a model before it is made smaller.

    Attributes:
        filters: Filters applied first, such as `nanogs.filters.box(low, high)`.
        sh_degree: Highest degree of harmonics to keep, or None for all.
        render_mode: Render mode in place of the one in the files, or None.
    """

    filters: Sequence[Filter] = ()
    sh_degree: int | None = None
    render_mode: RenderMode | None = None

    def check(self) -> None:
        """Refuse filters that are not possible in blocks.

        Raises:
            OptionError: A filter has to see the whole model, or is of a kind that no job records.
        """
        refuse_whole(self.filters)
        if any(each.plain is None for each in self.filters):
            raise OptionError(
                "A model in blocks can be filtered only with the filters of nanogs.filters; apply"
                " others to the model first."
            )


class ChangedModel(NamedTuple):
    """A model after the changes before it is made smaller: filters, and harmonics left out.

    Attributes:
        splats: The model.
        filtered: Report of each filter.
        notes: Other notes for the user, one sentence each.
    """

    splats: Splats
    filtered: tuple[FilterReport, ...]
    notes: tuple[str, ...]


def reading_stages(changes: Changes, splats: int) -> list[Stage]:
    """Return the stages of `read_changed`."""
    read = [Stage("read", read_weight(splats))]
    return [*read, Stage("filter", read_weight(splats))] if changes.filters else read


def read_changed(
    paths: Sequence[Path], changes: Changes, progress: Tracker, clock: StageClock
) -> ChangedModel:
    """Read a model of one or several files, and change it.

    Args:
        paths: The files, parts of one scene.
        changes: Changes to the model; see `changed`.
        progress: Notified of the stages.
        clock: Gets their seconds.

    Raises:
        NanogsError: A file cannot be read, or a filter leaves nothing.
    """
    progress.begin("read")
    with clock.time("read"):
        splats = read_parts(paths, changes.render_mode)
    if not changes.filters:
        return changed(splats, changes)
    progress.begin("filter")
    with clock.time("filter"):
        return changed(splats, changes)


def changed(splats: Splats, changes: Changes) -> ChangedModel:
    """Apply the filters, and leave out the harmonics that are not wanted.

    Raises:
        ModelError: A filter leaves nothing.
    """
    left, filtered = apply(splats, changes.filters)
    degree = changes.sh_degree
    if degree is None or degree >= left.sh_degree:
        return ChangedModel(left, filtered, ())
    return ChangedModel(left.with_sh_degree(degree), filtered, (dropped_first(degree),))


def dropped_first(degree: int) -> str:
    """Return the note on a model of which only the harmonics up to a degree are simplified."""
    return (
        f"Spherical harmonics above degree {degree} were dropped first; any PSNR is against the"
        " model without them."
    )


def inspect_parts(paths: Sequence[Path]) -> FileInfo:
    """Describe the files of a model: as the first file, with the splats and bytes of all.

    The SH degree is the highest of any file.

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


def read_parts(paths: Sequence[Path], render_mode: str | None) -> Splats:
    """Read the model of one file, or of several that are its parts.

    Args:
        paths: The files.
        render_mode: As `nanogs.load` takes it.

    Raises:
        NanogsError: A file cannot be read, or they do not go together.
    """
    if len(paths) == 1:
        return load(paths[0], render_mode=render_mode)
    with Joined(open_parts(paths, render_mode)) as source:
        return source.load()


def open_parts(paths: Sequence[Path], render_mode: str | None) -> list[FileSource]:
    """Open the files of a model, all with the given render mode if there is one.

    Args:
        paths: The files.
        render_mode: As `nanogs.open` takes it.

    Raises:
        FormatError: One of them cannot be read.
        OptionError: One of them cannot have that render mode.
    """
    return [open_model(path, render_mode=render_mode) for path in paths]
