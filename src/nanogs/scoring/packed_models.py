"""Models to compare, each with packed files of itself. Numba is not imported before loading."""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, TypeVar

from nanogs.cleanup import temporary_folder
from nanogs.io import open as open_model
from nanogs.io.parts import FileSource
from nanogs.progress import Stage, Tracker
from nanogs.scoring.packing import (
    PackingFormats,
    has_format,
    is_packed,
    notes_on,
    refuse_too_large_to_pack,
    write_packed,
)
from nanogs.source import Noted, Source, source_of
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.scoring.comparison import NamedModel

S = TypeVar("S", bound=Splats | Source)


def write_packed_files(
    models: Sequence[tuple[str, S]],
    packing: PackingFormats,
    stack: ExitStack,
    max_memory: int | None,
    progress: Tracker,
) -> list[tuple[str, S | FileSource, str]]:
    """Write each model in the packed formats, and return all models with the opened files.

    Each model is followed by its files. A format that the model's file already has is left out.

    Args:
        models: Names and models.
        packing: From `packing_of`.
        stack: Owns the files and their temporary folder, which are removed when it closes.
        max_memory: Bytes that this process may take; by default the free memory, less a tenth.
        progress: Receives the stage "pack", with a part for each file.

    Returns:
        Names, models, and the suffix of the format; empty for the models themselves.

    Raises:
        NanogsError: As for `refuse_too_large_to_pack` and `write_packed`.
    """
    for _, source in models:
        refuse_too_large_to_pack(source, packing, max_memory)
    progress.begin("pack")
    folder = stack.enter_context(temporary_folder("nanogs-"))
    files, done = files_of([source for _, source in models], packing), 0
    found: list[tuple[str, S | FileSource, str]] = []
    for place, (name, source) in enumerate(models):
        found.append((name, source, ""))
        for suffix, options in packing.items():
            if has_format(source, suffix):
                continue
            on_step = progress.within(done, files, [Stage("write", 1.0)]).passing()
            path = folder / f"{place}"
            path.mkdir(exist_ok=True)
            path = write_packed(source, suffix, options, path, on_step)
            found.append((f"{name} as {suffix}", stack.enter_context(open_model(path)), suffix))
            done += 1
    return found


def files_of(models: Sequence[Splats | Source], packing: PackingFormats) -> int:
    """Count the files that `write_packed_files` writes."""
    return sum(not has_format(source, suffix) for source in models for suffix in packing)


def packing_notes(
    models: Sequence[tuple[str, Splats | Source]], packing: PackingFormats
) -> tuple[str, ...]:
    """Return notes on models whose files are packed already, in one of the formats or another."""
    notes = []
    for name, source in models:
        same = [suffix for suffix in packing if has_format(source, suffix)]
        notes += [f"{name}: {_already(source, suffix)}" for suffix in same]
        if len(same) < len(packing):
            notes += [f"{name}: {note}" for note in notes_on(source)]
    return tuple(notes)


def _already(source: Splats | Source, suffix: str) -> str:
    """Return the note that a model's file has a format already, and is not written in it."""
    if not is_packed(source):
        return f"the file is already a {suffix} file, and is not written as one again."
    return (
        f"the file is already packed as {suffix} and is not packed again; to see what the packing"
        " cost, compare it with the model that it was made from."
    )


def reading_notes(
    given: Sequence[tuple[str, Splats | Source]], models: Sequence["NamedModel"]
) -> tuple[str, ...]:
    """Return the notes that reading files gave, prefixed by the names of the models.

    Args:
        given: Names and models; those in memory have been read before, and are left out.
        models: What `named` made of all of them, after it was rendered.
    """
    notes = [
        f"{name}: {note}"
        for (name, source), model in zip(given, models, strict=True)
        if isinstance(source, FileSource) and isinstance(model.splats, Splats | Noted)
        for note in model.splats.notes
    ]
    return tuple(dict.fromkeys(notes))


def named(name: str, source: Splats | Source, packed: str, whole: bool) -> "NamedModel":
    """Return a model ready for comparison.

    Args:
        name: Its name.
        source: The model.
        packed: Suffix from `write_packed_files`; empty for the model itself.
        whole: Load it now; otherwise it is read some rows at a time.
    """
    from nanogs.scoring.comparison import NamedModel

    file_bytes = source.info.file_bytes if isinstance(source, FileSource) else None
    opened = source_of(source)
    return NamedModel(name, opened.load() if whole else Noted(opened), file_bytes, packed)
