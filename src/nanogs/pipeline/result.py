"""The result: the blocks' parts in one file, made in the job folder and then moved into place.

A run that is killed between any two of its steps finds what was done by checksums.
"""

import json
import os
import shutil
from pathlib import Path

from nanogs.errors import OptionError
from nanogs.io import check_writable, registry, save
from nanogs.io.atomic import atomic_write
from nanogs.io.format import FormatOptions
from nanogs.pipeline.parts import Parts, further
from nanogs.pipeline.work import Work
from nanogs.source import InMemory, Source, Turned
from nanogs.store.scratch import hash_file


def refuse_large(path: Path, count: int, row: int, max_memory: int | None) -> None:
    """Refuse a result that would have to be held whole and is too large for that.

    Args:
        path: What is to be written.
        count: Splats of it.
        row: Bytes of a splat.
        max_memory: Bytes, or None for no limit.

    Raises:
        OptionError: It is too large, a folder, or in a format that is not written.
    """
    registry.writer(path)  # which refuses folders
    known = registry.writable(path)
    if not known.streams and max_memory is not None and 3 * count * row > max_memory:
        raise OptionError(
            f"{path}: {known.suffix} is not written block by block, and {count:,} splats are too"
            " many to be held whole; name a .ply file, or raise `max_memory`."
        )


def write_result(
    work: Work, level: int, file: Path, target: int, format_options: FormatOptions | None = None
) -> int:
    """Write the parts of a level to a file; the splats in it.

    Args:
        work: The job, all its tasks done.
        level: Of the result.
        file: What to write; replaced if it exists.
        target: Splats asked for; where blocks could not go as far, the rest is done in memory.
        format_options: As `save` takes them.

    Raises:
        OutputError: The file cannot be written.
    """
    with Parts(work, level) as parts:
        source: Source = parts
        if parts.count > target:
            source = InMemory(further(parts.load(), target, work.settings))
        if work.settings.frame is not None:
            source = Turned(source, *work.settings.frame)
        save(source, file, overwrite=True, format_options=format_options)
        return source.count


def move_into_place(file: Path, path: Path, *, overwrite: bool) -> None:
    """Give a finished file its name, across file systems if need be.

    Raises:
        OutputError: There is one of that name and `overwrite` is off, or it cannot be written.
    """
    check_writable(path, overwrite=overwrite)
    target = Path(os.path.realpath(path))
    if not target.exists() and file.stat().st_dev == target.parent.stat().st_dev:
        file.replace(target)
        return
    with atomic_write(path, overwrite=overwrite) as out, file.open("rb") as source:
        shutil.copyfileobj(source, out, 1 << 22)
    file.unlink()


def seal(file: Path, splats: int) -> None:
    """Note what a finished file is, beside it, so that it is known again under another name."""
    with file.open("rb") as source:
        count, digest = hash_file(source)
    with atomic_write(_note(file), overwrite=True) as out:
        out.write(json.dumps({"bytes": count, "sha256": digest, "splats": splats}).encode())


def sealed(file: Path, place: Path) -> int | None:
    """The splats of the file that was sealed, if it is what stands at a place."""
    try:
        note = json.loads(_note(file).read_bytes())
        if place.stat().st_size != note["bytes"]:
            return None
        with place.open("rb") as source:
            same = hash_file(source) == (note["bytes"], note["sha256"])
        return int(note["splats"]) if same else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _note(file: Path) -> Path:
    return file.with_name(f"{file.name}.json")
