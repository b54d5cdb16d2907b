"""Resolving the paths, folders and patterns that a user gives to input and output files."""

import glob
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nanogs.errors import FormatError, OptionError
from nanogs.io import registry
from nanogs.io.files import unreadable
from nanogs.io.urls import Address, as_path
from nanogs.paths import exists, is_file, is_folder
from nanogs.ranges import one_or_several

# Manifests: a folder with one of these is a single model.
WHOLE_FOLDERS = (registry.LEVELS, registry.TILESET, registry.META, "meta.lcc2")


@dataclass(frozen=True, slots=True)
class Pair:
    """An input file and the output file for its result."""

    source: Path
    target: Path


def collect(paths: Iterable[Path]) -> list[Path]:
    """Expand folders and patterns to the files they mean; files are returned unchanged.

    A folder is replaced by the models directly in it that are not hidden, or by its manifest if it
    is a SOG model, a streamed SOG model, 3D Tiles or XGRIDS' LCC2; a pattern (`*`, `?`, `[...]`,
    `**`) that is not the name of a file by everything that matches it, as in a shell. Each file is
    listed once, in the order given and by name within a folder.

    Raises:
        FormatError: A folder holds no model.
        OptionError: Nothing matches a pattern.
    """
    return list(dict.fromkeys(_named(paths)))


def collect_parts(paths: Iterable[Path]) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Expand paths as `collect` does to the parts of one scene, each file under any name once.

    Returns:
        The files, and a note on each that was named again.

    Raises:
        FormatError: A folder holds no model.
        OptionError: Nothing matches a pattern.
    """
    return _each_once(_named(paths))


def as_parts(given: object) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Convert an argument that names a file, or the parts of one scene, each file once.

    Args:
        given: A path or URL, or several.

    Returns:
        The files, and a note on each that was named again.

    Raises:
        OptionError: One is no path, or there is none.
    """
    paths = one_or_several(given)
    if not paths:
        raise OptionError("Give at least one file.")
    return _each_once(map(as_path, paths))


def _each_once(files: Iterable[Path]) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Return files under any name once, and a note on each that was named again."""
    parts: dict[str, Path] = {}
    notes: list[str] = []
    for file in files:
        own = str(file) if isinstance(file, Address) else os.path.realpath(file)
        if own in parts:
            notes.append(f"{file} was given more than once and is taken once.")
        parts.setdefault(own, file)
    return tuple(parts.values()), tuple(dict.fromkeys(notes))


def _named(paths: Iterable[Path]) -> list[Path]:
    return [file for path in paths for match in _matches(path) for file in _files(match)]


def model_in(path: Path) -> Path:
    """Return the file to open for a model in a folder; a path that is no folder is unchanged.

    That is its manifest, its only model, or, of a folder of levels of detail, the finest level.

    Raises:
        FormatError: The folder holds no model, or several.
    """
    if not is_folder(path):
        return path
    inside = _files(path)
    if len(inside) > 1 and not is_file(path / registry.LEVEL_LIST):
        names = ", ".join(file.name for file in inside[:4]) + " or another" * (len(inside) > 4)
        raise FormatError(f"The folder {path} holds {len(inside)} models; name one: {names}.")
    return inside[0]  # sorted by name, so of several levels the finest


def _matches(path: Path) -> list[Path]:
    if isinstance(path, Address) or exists(path) or not glob.has_magic(str(path)):
        return [path]
    matches = [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]  # noqa: PTH207
    if not matches:
        raise OptionError(f"Nothing matches {path}; check the pattern and the folder.")
    return matches


def _files(path: Path) -> list[Path]:
    if not is_folder(path):
        return [path]
    for name in WHOLE_FOLDERS:
        if is_file(path / name):
            return [path / name]
    try:
        inside = [file for file in sorted(path.iterdir()) if is_file(file) and _seen(file)]
    except OSError as error:
        raise unreadable(path, error) from error
    if not inside:
        raise FormatError(
            f"The folder {path} holds no file of a format that nanogs reads; name one that does."
        )
    return inside


def _seen(file: Path) -> bool:
    """Whether a file of a folder is a model, and not hidden, as the `._a.ply` of macOS."""
    known = None if file.name.startswith(".") else registry.find(file)
    # A chair.meta.json beside chair.ply only ends like a manifest; `_files` has looked for those.
    return known is not None and known.readable and known.suffix.startswith(".")


def pair_up(sources: Sequence[Path], folder: Path, suffix: str | None) -> list[Pair]:
    """Pair each input file with an output file of the same name in one folder.

    The result for a SOG model in a folder is named after that folder.

    Args:
        sources: Files to read.
        folder: Folder for the results.
        suffix: Format of the results, with or without its dot; by default each file's own.

    Raises:
        OptionError: The format is not written, or two files would have the same result.
    """
    pairs: dict[Path, Pair] = {}
    for source in sources:
        target = folder / (registry.stem_of(source) + _suffix(source, suffix))
        if target in pairs:
            raise OptionError(
                f"{pairs[target].source} and {source} would both become {target}; rename one or run"
                " them separately."
            )
        pairs[target] = Pair(source, target)
    return list(pairs.values())


def _suffix(source: Path, asked: str | None) -> str:
    if asked is not None:
        registry.writer(registry.file_of(asked))
        return registry.suffix_of(asked)
    known = registry.find(source)
    if known is not None and known.write is None and known.writable:
        raise OptionError(
            f"{source} describes a folder of files, but results are single files; add"
            ' `format="sog"`.'
        )
    if known is not None and known.write is None:
        raise OptionError(f'{source}: nanogs does not write {known.suffix}; add `format="ply"`.')
    return known.suffix if known else source.suffix
