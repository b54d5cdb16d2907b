"""Writing models in packed formats, to measure the loss due to that. Numba is not imported."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nanogs.errors import OptionError
from nanogs.io import registry, write_model
from nanogs.io.format import Format, FormatOptions, given_options
from nanogs.io.parts import FileSource
from nanogs.memory import allowed_memory, refuse_too_large
from nanogs.memory_estimates import convert_bytes
from nanogs.progress import Progress
from nanogs.ranges import one_or_several
from nanogs.source import Source, source_of
from nanogs.splats import Splats

PackingFormats = Mapping[str, FormatOptions]
"""Formats in which models are packed, by suffix, with the options for writing each."""

# Formats by their name in `FileInfo` or suffix -> the format that encodes values in the same way.
_SAME_ENCODING = {registry.META: "sog", "streamed sog": "sog"}


def packing_of(
    formats: str | Sequence[str], format_options: FormatOptions | None = None
) -> PackingFormats:
    """Return the formats by suffix, each with the options that it supports.

    Args:
        formats: A suffix, or several, with or without the dot.
        format_options: As for `save`.

    Raises:
        OptionError: No format is given, nanogs cannot write or read one, or no format supports an
            option or its value.
    """
    if not formats:
        raise OptionError("Name at least one format to pack the model in, such as .sog.")
    given = given_options(format_options)
    found = [registry.writable(registry.file_of(each)) for each in one_or_several(formats)]
    for known in found:
        if not known.readable:
            raise OptionError(
                f"nanogs does not read {known.suffix} files, so what packing costs cannot be"
                " measured; name another format, such as .sog."
            )
        known.check()
    packing: dict[str, dict[str, Any]] = {known.suffix: {} for known in found}
    for name, value in given.items():
        for known in [each for each in found if name in each.options] or found[:1]:
            registry.keywords(known, {name: value})  # raises if it lacks the option or the value
            packing[known.suffix][name] = value
    return packing


def refuse_packed(source: Splats | Source, packing: PackingFormats) -> None:
    """Refuse a format that the model's file already has.

    Raises:
        OptionError: The model's file has such a format, or one with the same encoding.
    """
    for suffix in packing:
        if has_format(source, suffix):
            encoding = _SAME_ENCODING.get(suffix, suffix.lstrip("."))
            if not is_packed(source):
                raise OptionError(
                    f"{source_of(source).name} is already a .{encoding} file; name another format,"
                    " such as .sog."
                )
            raise OptionError(
                f"{source_of(source).name} is already packed as .{encoding}; name another format,"
                " or compare it with the model that it was made from (`nanogs compare`)."
            )


def has_format(source: Splats | Source, suffix: str) -> bool:
    """Return whether a model comes from a file of a format, or of one with the same encoding."""
    name = suffix.removeprefix(".")
    return isinstance(source, FileSource) and _packed_as(source) == _SAME_ENCODING.get(name, name)


def is_packed(source: Splats | Source) -> bool:
    """Return whether a model comes from a file whose values are quantised."""
    if not isinstance(source, FileSource):
        return False
    known = _format_of(source)
    return source.packed or (known is not None and known.rounds)


def notes_on(source: Splats | Source) -> tuple[str, ...]:
    """Return a note on a model whose file is quantised already; () for others."""
    if not isinstance(source, FileSource) or not is_packed(source):
        return ()
    known = _format_of(source)
    name = known.suffix if known else _packed_as(source)
    note = (
        f"the file is itself packed, as {name}; unpacked means the model"
        " as read from it, so no number includes what that packing cost."
    )
    return (note,)


def _format_of(source: FileSource) -> Format | None:
    """Return the format of a model's file, or one with the same encoding; None if none is known."""
    return registry.find(Path(f"model.{_packed_as(source)}"))


def _packed_as(source: FileSource) -> str:
    return _SAME_ENCODING.get(source.info.format, source.info.format)


def refuse_too_large_to_pack(
    source: Splats | Source, packing: PackingFormats, max_memory: int | None, others: int = 0
) -> None:
    """Refuse formats for which there is not enough memory to convert the model's file.

    Models in memory are not checked.

    Args:
        source: The model.
        packing: From `packing_of`.
        max_memory: Bytes that this process may take; by default the free memory, less a tenth.
        others: Bytes of other data in memory at the same time.

    Raises:
        NotEnoughMemoryError: There is too little.
    """
    if not isinstance(source, FileSource):
        return
    for suffix, options in packing.items():
        if has_format(source, suffix):
            continue
        refuse_too_large(
            f"Packing {source.name} as {suffix}",
            convert_bytes(source, Path(f"packed{suffix}"), whole=False, options=options) + others,
            allowed_memory(max_memory),
            "name another format",
        )


def write_packed(
    model: Splats | Source,
    suffix: str,
    options: FormatOptions,
    folder: Path,
    progress: Progress | None = None,
) -> Path:
    """Write a model as a file of a format.

    Args:
        model: The model.
        suffix: Suffix of the format.
        options: As for `save`.
        folder: Folder for the file, without one of that format yet.
        progress: Receives the stage "write".

    Raises:
        ModelError: The format cannot hold the model at all.
        OutputError: The file cannot be written.
    """
    is_folder = registry.writable(Path(suffix)).write_folder is not None
    path = folder / "packed" / suffix if is_folder else folder / f"packed{suffix}"
    write_model(model, path, format_options=options, progress=progress)
    return path
