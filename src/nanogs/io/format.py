"""The description of a file format, its entry in the registry."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from nanogs.errors import FormatError, OptionError
from nanogs.formatting import listed
from nanogs.frames import TRAINED
from nanogs.io.folder import Ours
from nanogs.io.parts import FileSource
from nanogs.io.rate_distortion import Quantisation
from nanogs.progress import PartProgress
from nanogs.source import Layout, Source
from nanogs.splats import MAX_SH_DEGREE, Splats

PALETTE = "palette"  # name of the option for the number of sets of harmonics in a file
UNSTATED = "not stated in the file; y down (rdf) by convention"
FormatOptions = Mapping[str, Any]
"""Options for writing one format, by name, such as `spz_version`; None means the default."""
Writer = Callable[..., None]
"""Writes a model to a file that is open for binary writing."""
Sizer = Callable[[Splats, int], int]
"""Returns the file size in bytes of a model like the given one, but with this number of splats."""
Losses = Callable[[Splats], tuple[str, ...]]
"""Returns a sentence for each thing in a model that the format cannot hold; not quantisation."""
FolderWriter = Callable[..., None]
"""Writes a model as a folder; `overwrite` replaces one that nanogs made. See `io.save`."""


def nothing_lost(_splats: Splats) -> tuple[str, ...]:
    """Return no losses: the `losses` of a format that holds all of every model."""
    return ()


def given_options(options: FormatOptions | None) -> dict[str, Any]:
    """Return the options that are given, without those that are None.

    Raises:
        OptionError: They are no dictionary of names and values.
    """
    options = {} if options is None else options
    if not isinstance(options, Mapping) or not all(isinstance(name, str) for name in options):
        raise OptionError(f"Format options are a dictionary, as {{'bits': 6}}, not {options!r}.")
    return {name: value for name, value in options.items() if value is not None}


def options_text(options: FormatOptions | None) -> str:
    """Return options of a format as text, the same for equal ones, by which a job knows its own."""
    return json.dumps(dict(options or {}), sort_keys=True, default=str)


def unread(path: Path) -> NoReturn:
    """Refuse to read: the `open` of a format that nanogs only writes.

    Raises:
        FormatError: Always.
    """
    raise FormatError(f"{path}: nanogs writes this format but does not read it; name another file.")


class Sharing(NamedTuple):
    """The number of sets of higher harmonics that a result has, as a palette has entries.

    Attributes:
        per_set: Number of splats for each set.
        most: Most sets of the whole result.
        own: In a result of up to so many splats, each has a set of its own.
    """

    per_set: float
    most: int
    own: int = 1

    def entries(self, count: int, whole: int = 0) -> int:
        """Return the number of sets for `count` splats.

        These are all splats of a result, or a part of one of `whole` splats.
        """
        part = count / max(whole, count, 1)
        return max(int(min(max(count / self.per_set, self.own * part), self.most * part)), 1)


def shared_entries(
    sharing: Sharing | None, sh_degree: int, count: int, whole: int = 0
) -> int | None:
    """Return how many sets of higher harmonics splats of a result share; None if each has its own.

    Args:
        sharing: How the file's splats share them, or None if they do not.
        sh_degree: Degree of the result; at 0 there is nothing to share.
        count: Number of these splats.
        whole: Splats of the whole result, if they are a part of it.
    """
    if sharing is None or sh_degree == 0:
        return None
    entries = sharing.entries(count, whole)
    return entries if entries < count else None


@dataclass(frozen=True, slots=True)
class WriteOption:
    """An option for writing a format.

    Attributes:
        keyword: Name of the writer's parameter.
        values: Allowed values.
        search_start: For an option that sets the precision, with values from coarse to fine: the
            value with which a search for the best one starts; None for other options.
        without_rendering: For an option that sets the precision: the value for presets that do not
            render, when a file size is asked for; None for `search_start`.
        whole: Whether a writer that gets this option has to hold the whole model.
        of_harmonics: Whether it concerns only spherical harmonics above degree 0.
    """

    keyword: str
    values: tuple[Any, ...] | range
    search_start: int | None = None
    without_rendering: int | None = None
    whole: bool = False
    of_harmonics: bool = False

    @property
    def allowed(self) -> str:
        """The allowed values, for a message."""
        if isinstance(self.values, range):
            return f"a whole number from {self.values[0]:,} to {self.values[-1]:,}"
        return listed(self.values, "or")


# Memory that writing a whole model takes in addition to the model, as a multiple of its size.
_PACKED, _PALETTE = 0.4, 7.0


@dataclass(frozen=True, slots=True)
class Format:
    """One format: its file suffix, and the functions that read and write its files.

    Attributes:
        suffix: Suffix of its files; of a model that is a folder, the name of its manifest.
        open: Opens a file as a source.
        write: Writes a model to an open file.
        file_bytes: Computes the size of a file before it is written; never smaller for more splats.
        losses: Names what the format cannot hold of a model.
        shown: Of a format that nanogs does not read: returns a model as its file shows it, in the
            axes and units of the model, to measure it.
        open_level: Opens one level of detail, 0 the finest, of a format that has levels.
        frame: Text for the user: which axis points up.
        axes: Name of the coordinate frame of a model that was read; None if files differ.
        turns: Whether files have the format's own frame, so that reading and writing rotate.
        options: Options that `save` takes as `format_options`, by name.
        states_frame: Whether a file that is written with given options can state its frame, by
            the option `frame`.
        write_folder: Writes a model as a folder, for a format whose model is one.
        reports_progress: Whether `write` or `write_folder` takes a callback `on_progress`, because
            it takes long.
        streams: Whether `write` takes a source too and holds only some rows of it at a time, apart
            from options with `whole`.
        max_degree: Highest SH degree that files hold.
        any_value: Whether files hold NaN and infinite values, which other formats refuse.
        rounds: Whether files hold quantised values. If only some do, this is False, and
            `FileSource.packed` tells of each file.
        ours: Lists the files that nanogs made in such a folder.
        check: Fails before any computing if this installation cannot write the format.
        check_options: Fails if options contradict each other.
        check_columns: Fails if files cannot hold an extra column of a model.
        check_elements: Fails if files written with given options cannot hold the further PLY
            elements of a model, of which the names are given.
        derived_options: Computes options that are not given from the model, so that a similar model
            can be written in the same way.
        quantisation: Returns the values that a file written with given options can hold, if the
            bytes of a file depend on which of them are chosen.
        magic: First bytes, by which a file without a name is recognised.
        zip_member: Name of a file by which a zip without a name is recognised.
        named_files: Lists the other files that a file names, before they are there: for downloads.
        overhead_bytes: Number of bytes that every file has in addition to its splats, where it is
            large.
        sharing: How splats share sets of higher harmonics in files written without the option
            `palette`; None if each has its own.
    """

    suffix: str
    open: Callable[[Path], FileSource]
    write: Writer | None = None
    file_bytes: Sizer | None = None
    losses: Losses = nothing_lost
    shown: Callable[[Splats], Splats] | None = None
    open_level: Callable[[Path, int], FileSource] | None = None
    frame: str = UNSTATED
    axes: str | None = TRAINED
    turns: bool = False
    options: Mapping[str, WriteOption] = field(default_factory=dict)
    states_frame: Callable[[FormatOptions], bool] = lambda _options: False
    write_folder: FolderWriter | None = None
    reports_progress: bool = False
    streams: bool = False
    max_degree: int = MAX_SH_DEGREE
    any_value: bool = False
    rounds: bool = False
    ours: Ours | None = None
    check: Callable[[], None] = lambda: None
    check_options: Callable[[FormatOptions], None] = lambda _options: None
    check_columns: Callable[[Layout], None] = lambda _columns: None
    check_elements: Callable[[Sequence[str], FormatOptions], None] = lambda _names, _options: None
    derived_options: Callable[[Source, FormatOptions], FormatOptions] = lambda _source, _options: {}
    quantisation: Callable[[Splats, FormatOptions], Quantisation] | None = None
    magic: tuple[bytes, ...] = ()
    zip_member: str = ""
    named_files: Callable[[Path], Sequence[Path]] = lambda _path: ()
    overhead_bytes: Callable[[], int] = lambda: 0
    sharing: Sharing | None = None

    def sharing_with(self, options: FormatOptions) -> Sharing | None:
        """Return how splats share sets of higher harmonics in files written with given options."""
        palette = options.get(PALETTE)
        return self.sharing if palette is None else Sharing(1.0, int(palette))

    @property
    def readable(self) -> bool:
        """Whether nanogs reads the format."""
        return self.open is not unread

    def needs_whole_model(self, options: FormatOptions) -> bool:
        """Whether writing with these options holds the whole model and not only some rows."""
        given = given_options(options)
        return not self.streams or any(self.options[n].whole for n in given if n in self.options)

    def without_effect(self, options: FormatOptions | None, sh_degree: int) -> tuple[str, ...]:
        """Return a sentence for each given option that writing a model of this degree ignores."""
        return tuple(
            f"`{name}` had no effect, because the result has no spherical harmonics above degree 0."
            for name in given_options(options)
            if sh_degree == 0 and self.options[name].of_harmonics
        )

    def reporting(self, on_progress: PartProgress) -> dict[str, Any]:
        """Return the argument by which `write` and `write_folder` report progress, if they do."""
        return {"on_progress": on_progress} if self.reports_progress else {}

    def extra_memory(self, model: int) -> int:
        """Estimate the bytes of memory that writing takes beside a held model of `model` bytes."""
        return int(model * (_PALETTE if PALETTE in self.options else _PACKED))

    @property
    def writable(self) -> bool:
        """Whether nanogs writes the format, as a file or as a folder."""
        return bool(self.write or self.write_folder)
