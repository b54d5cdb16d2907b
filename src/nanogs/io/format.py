"""A format's entry in the registry."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from nanogs.errors import FormatError
from nanogs.frames import TRAINED
from nanogs.io.folder import Ours
from nanogs.io.parts import FileSource
from nanogs.source import Source
from nanogs.splats import MAX_SH_DEGREE, Splats

UNSTATED = "not stated in the file; y down (rdf) by habit"
FormatOptions = Mapping[str, Any]
"""Options of one format alone for writing, by name, such as `spz_version`; None is the default."""
Writer = Callable[..., None]
"""Writes a model to a file that is open for binary writing."""
Sizer = Callable[[Splats, int], int]
"""Bytes of the file of a model of so many splats that is like the given one in all else."""
Losses = Callable[[Splats], tuple[str, ...]]
"""Names what a file of the format cannot hold of a model, a sentence each, besides quantisation."""
FolderWriter = Callable[..., None]
"""Makes the folder of a model, with `overwrite` in place of one of nanogs' own; see `io.save`."""


def nothing_lost(_splats: Splats) -> tuple[str, ...]:
    """Stand in for the losses of a format that holds all of every model."""
    return ()


def unread(path: Path) -> NoReturn:
    """Stand in for the reader of a format that is only written.

    Raises:
        FormatError: Always.
    """
    raise FormatError(f"{path}: nanogs writes this format but does not read it; name another file.")


@dataclass(frozen=True, slots=True)
class WriteOption:
    """A choice in writing a format.

    Attributes:
        keyword: What the writer calls it.
        values: What it may be.
        begin: Of one that says how finely values are kept, from coarse to fine, the value with
            which a search for the best begins; None for others.
        unseen: Of such a one, the value for presets that do not render, where a size is asked for;
            None for `begin`.
        whole: Whether a writer to whom it is given has to hold the whole model.
    """

    keyword: str
    values: tuple[Any, ...] | range
    begin: int | None = None
    unseen: int | None = None
    whole: bool = False

    @property
    def allowed(self) -> str:
        """The values, for a message."""
        if isinstance(self.values, range):
            return f"a whole number from {self.values[0]:,} to {self.values[-1]:,}"
        return " or ".join(map(str, self.values))


# Bytes that writing takes beside a model that it holds, over those of the model.
_PACKED, _PALETTE = 0.4, 7.0


@dataclass(frozen=True, slots=True)
class Format:
    """One format: what its files are called, and how they are read and written.

    `open` gives a file as a source, and `open_level`, of a format with levels of detail, one of
    these; 0 is the finest. `file_bytes` tells the size of a file before it is written; never
    smaller for more splats. `frame` says which way is up, and `axes` is the name of the frame of a
    model that was read, or None where files differ; with `turns`, files are in the format's own
    frame, to and from which reading and writing turn. `options` are what `save` takes as
    `format_options` for it; where `states_frame` says so of some, `frame` is one, which files then
    state. Of a format whose model is a folder, described by the file of the name
    `suffix` in it, `write_folder` makes that folder and `ours` says what in such a folder nanogs
    made. With `tells`, `write` takes `tell`: it takes long, and tells its parts. With `streams`,
    `write` takes a source too, and holds no more than some rows of it, but for options that say
    so. `max_degree` is the highest degree of harmonics that files hold. `check` fails before any
    computing where this installation cannot write the format. Files without a name are known by
    what they begin with, one of `starts`, or, where they are zips, by a file that is in them,
    `holds`. `check_options` fails where options do not go together. `settled` gives options that
    follow from the model unless they are given, by which a like one can be written in the same way.
    `around` gives the bytes that every file has around its splats, where these are many.
    """

    suffix: str
    open: Callable[[Path], FileSource]
    write: Writer | None = None
    file_bytes: Sizer | None = None
    losses: Losses = nothing_lost
    open_level: Callable[[Path, int], FileSource] | None = None
    frame: str = UNSTATED
    axes: str | None = TRAINED
    turns: bool = False
    options: Mapping[str, WriteOption] = field(default_factory=dict)
    states_frame: Callable[[FormatOptions], bool] = lambda _options: False
    write_folder: FolderWriter | None = None
    tells: bool = False
    streams: bool = False
    max_degree: int = MAX_SH_DEGREE
    ours: Ours | None = None
    check: Callable[[], None] = lambda: None
    check_options: Callable[[FormatOptions], None] = lambda _options: None
    settled: Callable[[Source, FormatOptions], FormatOptions] = lambda _source, _options: {}
    starts: tuple[bytes, ...] = ()
    holds: str = ""
    around: Callable[[], int] = lambda: 0

    @property
    def readable(self) -> bool:
        """Whether nanogs reads it."""
        return self.open is not unread

    def holds_whole(self, options: FormatOptions) -> bool:
        """Whether writing with such options holds the whole model, and not some rows of it."""
        given = [name for name, value in options.items() if value is not None]
        return not self.streams or any(self.options[n].whole for n in given if n in self.options)

    def beside(self, model: int) -> int:
        """Bytes that writing takes beside a model of so many bytes, where it holds that whole."""
        return int(model * (_PALETTE if "palette" in self.options else _PACKED))

    @property
    def writable(self) -> bool:
        """Whether nanogs writes it, as a file or as a folder."""
        return bool(self.write or self.write_folder)
