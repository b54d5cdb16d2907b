"""The environment of streamed levels, such as a sky, and the scene without it.

Viewers draw the environment with every level. It is another model that the caller names, or the
part of the model that `lod` recognises as one; levels are then made of the rest, so that each splat
is drawn once.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path

from nanogs import filters
from nanogs.errors import ModelError, OptionError
from nanogs.formatting import counted, exact_text
from nanogs.frames import turned
from nanogs.io import load
from nanogs.io import open as open_model
from nanogs.io.files import splat_bytes
from nanogs.io.frames import refuse_frame_read, refuse_mixed_frames
from nanogs.io.models import as_splats
from nanogs.io.parts import FileSource
from nanogs.io.retag import in_mode
from nanogs.io.url_files import refuse_address
from nanogs.io.urls import as_path
from nanogs.lod.environment import Shell, find_environment
from nanogs.lod.layout import LodLayout
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.pipeline.api import simplify
from nanogs.pipeline.in_memory import NanPolicy
from nanogs.pipeline.reading import changed, open_parts, read_parts
from nanogs.pipeline.request import Request
from nanogs.ranges import is_number, value_text
from nanogs.report import SimplifyReport
from nanogs.sink import Environment, Read
from nanogs.source import Filtered, InMemory, Joined, Source
from nanogs.splats import Splats

AUTO, NONE = "auto", "none"
_LAYOUTS = (LodLayout.SOG, LodLayout.ARCHIVE)
# Memory for writing a SOG file: this many times the columns, and bytes for each splat.
_HELD, _EACH = 7, 300


@dataclass(frozen=True, slots=True)
class EnvironmentRequest:
    """A request for an environment.

    Attributes:
        asked: "auto", which searches the model for one, "none", or the environment's model.
        ratio: Share of the environment's splats to keep, in (0, 1].
    """

    asked: str | PathLike[str] | Splats | Source = NONE
    ratio: float = 1.0

    def in_memory(self, request: Request, splats: Splats) -> tuple[Splats, Environment | None]:
        """Split a model in memory into the rest and its environment, which is None if it has none.

        Args:
            request: The request for levels.
            splats: The model after filters.

        Raises:
            NanogsError: The model of an environment cannot be read, has another render mode or
                frame, or holds a NaN or an infinite value that is to be an error.
        """
        if self.asked == NONE:
            return splats, None
        if self.asked != AUTO:
            return splats, self._given(request, splats.render_mode)
        shell = find_environment(InMemory(splats))
        if shell is None:
            return splats, None
        _refuse_nonfinite(shell, request.nan)
        _refuse_large(shell.splats, splats.sh_degree, request.max_memory)
        without, sky = (splats.take(each.keep(splats)) for each in (_within(shell), _beyond(shell)))
        return without, self._made(request, AUTO, len(sky), lambda: sky)

    def in_blocks(self, request: Request) -> tuple[Request, Environment | None]:
        """Return the request with a filter that removes the environment, and the environment.

        The latter is None if the model has none. The model is read block by block.

        Args:
            request: The request for levels.

        Raises:
            NanogsError: The model cannot be read, or its environment is too large for memory, has
                another render mode or frame, or holds a NaN or an infinite value that is to be an
                error.
        """
        if self.asked == NONE:
            return request, None
        if self.asked != AUTO:
            with _rows(request, ()) as source:
                mode = source.columns.render_mode
            found = self._given(request, mode)
            return self._named(request, found), found
        with _rows(request, request.filters) as source:
            shell = find_environment(source)
            degree = source.columns.sh_degree
        if shell is None:
            return request, None
        _refuse_nonfinite(shell, request.nan)
        _refuse_large(shell.splats, degree, request.max_memory)
        beyond = (*request.filters, _beyond(shell))

        def sky() -> Splats:
            with _rows(request, beyond) as source:
                return source.read(0, source.count)

        taken = replace(request, filters=(*request.filters, _within(shell)))
        found = self._made(request, AUTO, shell.splats, sky)
        return self._named(taken, found), found

    def planned(self, request: Request, *, divided: bool) -> tuple[Request, Environment | None]:
        """Do what `in_blocks` does for a plan that is shown before the work begins.

        Args:
            request: The request for levels.
            divided: Whether the model is to be processed in blocks; else it is read into memory.

        Raises:
            NanogsError: See `in_blocks`.
        """
        if divided or self.asked != AUTO:
            return self.in_blocks(request)
        splats = changed(read_parts(request.inputs, request.render_mode), request.edits).splats
        shell = find_environment(InMemory(splats))
        if shell is None:
            return request, None
        _refuse_nonfinite(shell, request.nan)
        taken, beyond = replace(request, filters=(*request.filters, _within(shell))), _beyond(shell)
        sky = partial(splats.take, beyond.keep(splats))
        return taken, self._made(request, AUTO, shell.splats, sky)

    def notes(self, found: Environment | None) -> tuple[str, ...]:
        """Return notes on the environment, or that one to be simplified was not found."""
        if found is not None:
            return found.notes
        if self.ratio == 1:
            return ()
        note = (
            "No environment was found around the model, so the environment's ratio has no effect;"
            " name a file with `environment`, or leave the ratio out."
        )
        return (note,)

    def _named(self, request: Request, found: Environment) -> Request:
        """Add the environment to the request, so that no job resumes with a different one."""
        name = f"{found.source}, {counted(found.count, 'splat')}, ratio {exact_text(self.ratio)}"
        return replace(request, environment=name)

    def _given(self, request: Request, mode: str) -> Environment:
        """Return the environment that the caller names, for a model of a render mode."""
        if isinstance(self.asked, Splats | Source):
            asked = request.edits.render_mode
            splats = in_mode(as_splats(self.asked), asked, "The environment")
            _refuse_other_mode(mode, splats.render_mode)
            _refuse_unusable(InMemory(splats), "a model", request.nan)
            return self._made(request, "a model", len(splats), lambda: splats)
        path = Path(self.asked)
        with open_model(path, render_mode=request.render_mode) as source:
            info = source.info
            _refuse_other_mode(mode, info.render_mode)
            notes = _refuse_other_frame(request, source)
            _refuse_large(info.splats, info.sh_degree, request.max_memory)
            _refuse_unusable(source, path.name, request.nan)
        read = partial(load, path, render_mode=request.render_mode)
        return replace(self._made(request, path.name, info.splats, read), notes=notes)

    def _made(self, request: Request, source: str, count: int, read: Read) -> Environment:
        def whole() -> Splats:
            found = _usable(read())
            degree = request.edits.sh_degree
            return found if degree is None else found.with_sh_degree(degree)

        def made() -> Splats:
            found = whole()
            if request.sh_degree is not None:
                found = found.with_sh_degree(request.sh_degree)
            if self.ratio < 1:
                small, _ = simplify(found, ratio=self.ratio, preset="fast", threads=request.threads)
                found = replace(small, notes=found.notes)
            return turned(found, request.frame)

        return Environment(source, count, self.asked == AUTO, whole, made)


NOTHING = EnvironmentRequest()


def surroundings(
    asked: str | PathLike[str] | Splats | Source, ratio: float | None, layout: LodLayout | str
) -> EnvironmentRequest:
    """Check the arguments about an environment, and make a request of them.

    Args:
        asked: "auto", "none", a path or a model.
        ratio: Share of the environment's splats to keep, or None for all.
        layout: Layout of the levels.

    Raises:
        OptionError: The environment is none of these, the layout has no environment, the path is a
            URL, or the ratio is not in (0, 1].
    """
    if not isinstance(asked, str | PathLike | Splats | Source):
        raise OptionError(
            f'`environment` must be "{AUTO}", "{NONE}" for no environment, a path or a model, not'
            f" {asked!r}."
        )
    named = not (isinstance(asked, str) and asked in (AUTO, NONE))
    if isinstance(asked, str | PathLike) and named:
        asked = as_path(asked)
        refuse_address(asked, "name a file for the environment")
    if layout not in _LAYOUTS:
        if named or ratio is not None:
            raise OptionError(
                "Only streamed SOG can have an environment; write a lod-meta.json or a .ssog."
            )
        return EnvironmentRequest()
    if ratio is not None and not (is_number(ratio) and 0 < ratio <= 1):
        given = value_text(ratio)
        raise OptionError(
            f"The ratio of the environment must be above 0 and at most 1, not {given}."
        )
    if ratio is not None and asked == NONE:
        raise OptionError("There is no environment to simplify; leave out its ratio.")
    return EnvironmentRequest(asked, 1.0 if ratio is None else ratio)


def without_environment(reports: Sequence[SimplifyReport]) -> list[SimplifyReport]:
    """Return the reports without that of the filter which removed the environment."""
    own = filters.ENVIRONMENT
    return [
        replace(each, filters=tuple(took for took in each.filters if took.name != own))
        for each in reports
    ]


def _refuse_nonfinite(shell: Shell, nan: NanPolicy) -> None:
    """Refuse a model whose environment holds values that are not finite, with `nan="error"`.

    Levels are made of the rest, so nothing else would find them before these are written.

    Raises:
        ModelError: It does.
    """
    if nan == "error" and (count := shell.splats - shell.usable):
        what = counted(count, "splat of its environment holds", "splats of its environment hold")
        raise ModelError(
            f"The model cannot be used: {what} a NaN or an infinite value; leave them out with"
            ' `nan="drop"`.'
        )


def _refuse_unusable(source: Source, name: str, nan: NanPolicy) -> None:
    """Refuse the model of an environment without a finite splat, and others as `nan` says.

    Raises:
        ModelError: No splat is finite, or with `nan="error"` one is not.
    """
    usable = sum(int(rows.finite().sum()) for rows in source.blocks())
    count = source.count - usable
    if count and (nan == "error" or not usable):
        what = f"{counted(count, 'splat holds', 'splats hold')} a NaN or an infinite value"
        raise ModelError(f"The environment, {name}, cannot be used: {what}; name another one.")


def _usable(splats: Splats) -> Splats:
    """Remove splats that are not finite from an environment, and add a note about them."""
    finite = splats.finite()
    if finite.all():
        return splats
    splats_text = counted(int((~finite).sum()), "splat")
    note = f"Left out of the environment: {splats_text} with a NaN or an infinite value."
    return replace(splats.take(finite), notes=(*splats.notes, note))


def _within(shell: Shell) -> filters.Filter:
    return filters.within(shell.centre, shell.radius)


def _beyond(shell: Shell) -> filters.Filter:
    return filters.beyond(shell.centre, shell.radius)


def _rows(request: Request, kept: Sequence[filters.Filter]) -> Source:
    """Open the requested files as one source, with filters applied."""
    source: Source = Joined(open_parts(request.inputs, request.render_mode))
    return Filtered(source, kept) if kept else source


def _refuse_other_mode(model: str, environment: str) -> None:
    """Refuse an environment of another render mode than the model's.

    Viewers draw both at once, in one mode.

    Raises:
        ModelError: It is.
    """
    if model != environment:
        raise ModelError(
            f"The model and its environment have different render modes ({model} and"
            f" {environment}) and cannot form one scene; leave the environment out, or set one mode"
            " for both with `render_mode`."
        )


def _refuse_other_frame(request: Request, environment: FileSource) -> tuple[str, ...]:
    """Refuse the file of an environment that is in another frame than the model.

    Returns:
        A note for the user if the frame of some files is a guess.

    Raises:
        ModelError: It is.
        OptionError: The model is to be turned from another frame than the environment has.
    """
    with ExitStack() as stack:
        opened = open_parts(request.inputs, request.render_mode)
        files = [*(stack.enter_context(file) for file in opened), environment]
        notes = refuse_mixed_frames(files, request.frame[0] if request.frame else "")
    if request.frame is not None:
        refuse_frame_read(request.frame, [environment])
    return notes


def _refuse_large(count: int, degree: int, max_memory: int | None) -> None:
    refuse_too_large(
        f"Writing the environment, {counted(count, 'splat')} in one file,",
        count * (_HELD * splat_bytes(degree) + _EACH),
        allowed_memory(max_memory),
        'leave it in the levels with `environment="none"`',
    )
