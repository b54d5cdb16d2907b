"""`render_mode=`: a file that names the wrong rasteriser, read as if it named another."""

from dataclasses import replace
from functools import cached_property

from nanogs.errors import OptionError
from nanogs.io.around import Around
from nanogs.io.info import FileInfo
from nanogs.io.parts import FileSource
from nanogs.io.render_tag import agreeing
from nanogs.source import Layout
from nanogs.splats import RenderMode, Splats

ASKED = RenderMode.DEFAULT, RenderMode.MIP
"""The render modes that can stand in place of a file's own."""


def checked_mode(render_mode: str | None) -> RenderMode | None:
    """A render mode that is asked for in place of a file's own; None for the file's own.

    Raises:
        OptionError: It is neither "default" nor "mip".
    """
    if render_mode is None or render_mode in ASKED:
        return None if render_mode is None else RenderMode(render_mode)
    raise OptionError(
        f'A render mode that is asked for is "default" or "mip", not {render_mode!r}: 2dgs is no'
        " other way to draw a model, but another kind of model."
    )


def retagged(file: FileSource, render_mode: str | None) -> FileSource:
    """A file whose render mode is the one that is asked for; the file itself where it says so too.

    Args:
        file: The file.
        render_mode: "default", "mip", or None for the file's own.

    Raises:
        OptionError: It is neither, or antialiasing is asked for of a 2DGS model.
    """
    mode = checked_mode(render_mode)
    if mode is None or mode is file.info.render_mode:
        return file
    refuse_mode(file.name, file.info.render_mode, mode)
    return Retagged(file, mode)


def refuse_mode(name: str, own: str, mode: RenderMode) -> None:
    """Refuse antialiasing of flat splats, which the rasteriser of 2DGS does not know.

    Args:
        name: What the model is called.
        own: The render mode that it names.
        mode: The one that is asked for.

    Raises:
        OptionError: That is asked for.
    """
    if own == RenderMode.SURFEL and mode is RenderMode.MIP:
        raise OptionError(
            f"{name} is tagged 2dgs, and flat splats are not trained with antialiasing; only"
            " default can stand in place of that tag."
        )


def override_note(info: FileInfo, mode: RenderMode) -> str:
    """The sentence for the user about a tag that was not followed."""
    where = f", by {info.render_tag}" if info.render_tag else " for lack of a tag"
    return f"The render mode is {mode}, as asked for; the file has {info.render_mode}{where}."


class Retagged(Around):
    """A file with another render mode than its own; all else, and every row, is the file's.

    Args:
        file: The file, which is closed with this.
        mode: The render mode that it is to have.
    """

    def __init__(self, file: FileSource, mode: RenderMode) -> None:
        super().__init__(file)
        self._mode = mode

    @cached_property
    def info(self) -> FileInfo:
        """The file's description, with the render mode."""
        return replace(self.file.info, render_mode=self._mode, render_tag="what was asked for")

    @cached_property
    def columns(self) -> Layout:
        """The file's columns, with the render mode, and without comments that name another."""
        known = self.file.columns
        comments = tuple(agreeing(known.comments, self._mode))
        return replace(known, render_mode=self._mode.value, comments=comments)

    @property
    def remarks(self) -> tuple[str, ...]:
        """That the tag was not followed; see `FileSource`."""
        return (override_note(self.file.info, self._mode),)

    def _changed(self, splats: Splats) -> Splats:
        comments, notes = agreeing(splats.comments, self._mode), [*splats.notes, *self.remarks]
        return replace(splats, render_mode=self._mode, comments=comments, notes=notes)
