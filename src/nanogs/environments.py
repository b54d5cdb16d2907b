"""The environment of streamed levels: which model it is, and a scene without it.

Viewers draw it with every level. It is another model that the caller names, or what `lod` finds in
the model itself; levels are then made of the rest, so that each splat is drawn once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path

from nanogs import filters
from nanogs.errors import ModelError, OptionError
from nanogs.formatting import counted
from nanogs.frames import change_frame
from nanogs.io import inspect, load
from nanogs.io.files import splat_bytes
from nanogs.io.models import as_splats
from nanogs.io.stand_ins import refuse_address
from nanogs.io.urls import place
from nanogs.lod.environment import Shell, find_environment
from nanogs.lod.layout import Layout
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.pipeline.api import simplify
from nanogs.pipeline.job import NanPolicy
from nanogs.pipeline.reading import prepare, read_parts
from nanogs.pipeline.request import Request
from nanogs.pipeline.rows import open_parts
from nanogs.ranges import is_number, value_text
from nanogs.report import SimplifyReport
from nanogs.sink import Environment, Read
from nanogs.source import Filtered, InMemory, Joined, Source
from nanogs.splats import Splats

AUTO, NONE = "auto", "none"
_LAYOUTS = (Layout.SOG, Layout.ARCHIVE)
_HELD, _EACH = 7, 300  # times its columns, and bytes a splat, that a SOG file takes in the making


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The environment that is asked for.

    Attributes:
        asked: "auto", which looks for one, "none", or the model.
        ratio: What is kept of its splats, in (0, 1].
    """

    asked: str | PathLike[str] | Splats | Source = NONE
    ratio: float = 1.0

    def in_memory(self, request: Request, splats: Splats) -> tuple[Splats, Environment | None]:
        """A model without its environment, and the latter; None without.

        Args:
            request: What is asked for.
            splats: The model, of which filters have taken what they take.

        Raises:
            NanogsError: The model of an environment cannot be read.
        """
        if self.asked == NONE:
            return splats, None
        if self.asked != AUTO:
            return splats, self._given(request)
        shell = find_environment(InMemory(splats))
        if shell is None:
            return splats, None
        _refuse_large(shell.splats, splats.sh_degree, request.max_memory)
        without, sky = (splats.take(each.keep(splats)) for each in (_within(shell), _beyond(shell)))
        return without, self._made(request, AUTO, len(sky), lambda: sky)

    def in_blocks(self, request: Request) -> tuple[Request, Environment | None]:
        """The request for a model without its environment, and the latter; None without.

        Args:
            request: What is asked for.

        Raises:
            NanogsError: The model cannot be read, or its environment is too large to be held.
        """
        if self.asked == NONE:
            return request, None
        if self.asked != AUTO:
            found = self._given(request)
            return self._named(request, found), found
        with _rows(request, request.filters) as source:
            shell = find_environment(source)
            degree = source.columns.sh_degree
        if shell is None:
            return request, None
        _refuse_large(shell.splats, degree, request.max_memory)
        beyond = (*request.filters, _beyond(shell))

        def sky() -> Splats:
            with _rows(request, beyond) as source:
                return source.read(0, source.count)

        taken = replace(request, filters=(*request.filters, _within(shell)))
        found = self._made(request, AUTO, shell.splats, sky)
        return self._named(taken, found), found

    def planned(self, request: Request, *, divided: bool) -> tuple[Request, Environment | None]:
        """As `in_blocks`, to be shown beforehand of a model in memory too.

        Args:
            request: What is asked for.
            divided: Whether it is met in blocks.

        Raises:
            NanogsError: As for `in_blocks`.
        """
        if divided or self.asked != AUTO:
            return self.in_blocks(request)
        splats = prepare(read_parts(request.inputs, request.render_mode), request.edits).splats
        shell = find_environment(InMemory(splats))
        if shell is None:
            return request, None
        taken, beyond = replace(request, filters=(*request.filters, _within(shell))), _beyond(shell)
        sky = partial(splats.take, beyond.keep(splats))
        return taken, self._made(request, AUTO, shell.splats, sky)

    def _named(self, request: Request, found: Environment) -> Request:
        """The request as a job records it, which is not continued with another environment."""
        name = f"{found.source}, {counted(found.count, 'splat')}, ratio {self.ratio:g}"
        return replace(request, environment=name)

    def _given(self, request: Request) -> Environment:
        if isinstance(self.asked, Splats | Source):
            splats = as_splats(self.asked)
            return self._made(request, "a model", len(splats), lambda: splats)
        path = Path(self.asked)
        info = inspect(path)
        _refuse_large(info.splats, info.sh_degree, request.max_memory)
        read = partial(load, path, render_mode=request.render_mode)
        return self._made(request, path.name, info.splats, read)

    def _made(self, request: Request, source: str, count: int, read: Read) -> Environment:
        def whole() -> Splats:
            found = _usable(read(), source, request.nan)
            degree = request.edits.sh_degree
            return found if degree is None else found.with_sh_degree(degree)

        def made() -> Splats:
            found = whole()
            if request.sh_degree is not None:
                found = found.with_sh_degree(request.sh_degree)
            if self.ratio < 1:
                small, _ = simplify(found, ratio=self.ratio, preset="fast", threads=request.threads)
                found = replace(small, notes=found.notes)
            return change_frame(found, *request.frame) if request.frame else found

        return Environment(source, count, self.asked == AUTO, whole, made)


NOTHING = Surroundings()


def surroundings(
    asked: str | PathLike[str] | Splats | Source, ratio: float | None, layout: Layout | str
) -> Surroundings:
    """The environment that is asked for, of levels in a layout.

    Args:
        asked: "auto", "none", a path or a model.
        ratio: What is kept of its splats, or None for all.
        layout: How the levels lie.

    Raises:
        OptionError: The layout has none, the path is a URL, or the ratio is not in (0, 1].
    """
    named = not (isinstance(asked, str) and asked in (AUTO, NONE))
    if isinstance(asked, str | PathLike) and named:
        asked = place(asked)
        refuse_address(asked, "name a file for the environment")
    if layout not in _LAYOUTS:
        if named or ratio is not None:
            raise OptionError(
                "An environment belongs to streamed SOG; write a lod-meta.json or a .ssog."
            )
        return Surroundings()
    if ratio is not None and not (is_number(ratio) and 0 < ratio <= 1):
        given = value_text(ratio)
        raise OptionError(
            f"The ratio of the environment must be above 0 and at most 1, not {given}."
        )
    if ratio is not None and asked == NONE:
        raise OptionError("Without an environment there is none to simplify; leave its ratio out.")
    return Surroundings(asked, 1.0 if ratio is None else ratio)


def without_environment(reports: Sequence[SimplifyReport]) -> list[SimplifyReport]:
    """Reports as they are without the filter that left the environment out of the levels."""
    own = filters.ENVIRONMENT
    return [
        replace(each, filters=tuple(took for took in each.filters if took.name != own))
        for each in reports
    ]


def _usable(splats: Splats, source: str, nan: NanPolicy) -> Splats:
    """An environment without splats that are not finite, which a note tells.

    Raises:
        ModelError: None is usable, or `nan="error"` and one is not.
    """
    finite = splats.finite()
    if finite.all():
        return splats
    left_out = counted(int((~finite).sum()), "splat holds", "splats hold")
    what = f"{left_out} a NaN or an infinite value"
    if nan == "error" or not finite.any():
        raise ModelError(f"The environment, {source}: {what}; name another one.")
    note = f"The environment: {what}; left out."
    return replace(splats.take(finite), notes=(*splats.notes, note))


def _within(shell: Shell) -> filters.Filter:
    return filters.within(shell.centre, shell.radius)


def _beyond(shell: Shell) -> filters.Filter:
    return filters.beyond(shell.centre, shell.radius)


def _rows(request: Request, kept: Sequence[filters.Filter]) -> Source:
    """The model of the files that are asked for, of which filters leave some rows."""
    source: Source = Joined(open_parts(request.inputs, request.render_mode))
    return Filtered(source, kept) if kept else source


def _refuse_large(count: int, degree: int, max_memory: int | None) -> None:
    refuse_too_large(
        f"Writing the environment, {counted(count, 'splat')} in one file,",
        count * (_HELD * splat_bytes(degree) + _EACH),
        allowed_memory(max_memory),
        'leave it in the levels with `environment="none"`, or allow more',
    )
