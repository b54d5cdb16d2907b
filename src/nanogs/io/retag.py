"""The argument `render_mode=`: overriding a wrong render mode tag when a file is read."""

from dataclasses import replace
from functools import cached_property

from nanogs.errors import OptionError
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource
from nanogs.io.render_tag import agreeing
from nanogs.io.wrapper import SourceWrapper
from nanogs.source import Layout
from nanogs.splats import RenderMode, Splats

ASKED = RenderMode.DEFAULT, RenderMode.MIP
"""Render modes with which a caller can override the mode that a file states."""


def checked_mode(render_mode: str | None) -> RenderMode | None:
    """Validate a requested render mode; None means the file's own.

    Raises:
        OptionError: It is neither "default" nor "mip".
    """
    if render_mode is None or render_mode in ASKED:
        return None if render_mode is None else RenderMode(render_mode)
    reason = ": it is not another way to draw a model, but another kind of model"
    why = reason if render_mode == RenderMode.SURFEL else ""
    raise OptionError(f'`render_mode` must be "default" or "mip", not {render_mode!r}{why}.')


def retagged(file: FileSource, render_mode: str | None) -> FileSource:
    """Wrap a file so that it has the requested render mode; unchanged if it has it already.

    Args:
        file: The file.
        render_mode: "default", "mip", or None for the file's own.

    Raises:
        OptionError: It is neither, or antialiasing is requested for a 2DGS model.
    """
    mode = checked_mode(render_mode)
    if mode is None or mode is file.info.render_mode:
        return file
    refuse_mode(file.name, file.info.render_mode, mode)
    return Retagged(file, mode)


def in_mode(splats: Splats, mode: RenderMode | None, name: str) -> Splats:
    """Return a model in memory with the requested render mode, and a note if it had another.

    Args:
        splats: The model.
        mode: The render mode, or None for the model's own.
        name: Name of the model, for the message.

    Raises:
        OptionError: Antialiasing is requested for a 2DGS model.
    """
    if mode is None or mode is splats.render_mode:
        return splats
    refuse_mode(name, splats.render_mode, mode)
    return _drawn_as(
        splats, mode, f"The render mode is {mode}, as requested; it was {splats.render_mode}."
    )


def _drawn_as(splats: Splats, mode: RenderMode, *notes: str) -> Splats:
    """Return a model with a render mode and further notes, without comments that state another."""
    comments = agreeing(splats.comments, mode)
    return replace(splats, render_mode=mode, comments=comments, notes=[*splats.notes, *notes])


def refuse_mode(name: str, own: str, mode: RenderMode) -> None:
    """Refuse antialiasing ("mip") for flat splats, because the 2DGS rasteriser has none.

    Args:
        name: Name of the model, for the message.
        own: The render mode that its file states.
        mode: The requested render mode.

    Raises:
        OptionError: Antialiasing is requested for a 2DGS model.
    """
    if own == RenderMode.SURFEL and mode is RenderMode.MIP:
        raise OptionError(
            f"{name} is tagged 2dgs, and flat splats are not trained with antialiasing; only"
            " default can override that tag."
        )


def override_note(info: FileInfo, mode: RenderMode) -> str:
    """Return the note for the user that the render mode of the file was overridden."""
    where = f", by {info.render_tag}" if info.render_tag else ", because it has no tag"
    return f"The render mode is {mode}, as requested; the file has {info.render_mode}{where}."


class Retagged(SourceWrapper):
    """A wrapper that replaces the render mode of a file, and nothing else.

    Args:
        file: The file, which is closed with this source.
        mode: The new render mode.
    """

    def __init__(self, file: FileSource, mode: RenderMode) -> None:
        super().__init__(file)
        self._mode = mode

    @cached_property
    def info(self) -> FileInfo:
        """The metadata of the file, with the new render mode."""
        return replace(self.file.info, render_mode=self._mode, render_tag="the request")

    @cached_property
    def columns(self) -> Layout:
        """The columns of the file, with the new mode and without comments that state another."""
        known = self.file.columns
        comments = tuple(agreeing(known.comments, self._mode))
        return replace(known, render_mode=self._mode.value, comments=comments)

    @property
    def remarks(self) -> tuple[str, ...]:
        """The note that the render mode was overridden; see `FileSource`."""
        return (override_note(self.file.info, self._mode),)

    def _changed(self, splats: Splats) -> Splats:
        return _drawn_as(splats, self._mode, *self.remarks)
