"""Output folders that appear whole or not at all; see `atomic` for files.

The files go to a temporary folder beside the target, which then takes the target's place. An
existing folder is only replaced if it holds nothing but files that its own manifest names; the new
one gets its permission bits.
"""

import contextlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from nanogs.cleanup import defer_exit
from nanogs.errors import ExistsError, OutputError, shown_as
from nanogs.io.atomic import keep_mode, refuse_read_only, refuse_without_parent, writing
from nanogs.io.temporary import left_beside, locked, name_beside, temporary

Ours = Callable[[Path], frozenset[str] | None]
"""Lists the files that nanogs made in a folder, as relative paths with slashes; returns None for a
folder that nanogs did not make."""


@contextmanager
def atomic_folder(path: Path, ours: Ours, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield a temporary folder, renamed to `path` if the block ends without an exception.

    Args:
        path: The folder to make.
        ours: Lists the files of an existing folder that may be deleted.
        overwrite: Whether an existing folder may be replaced; an empty one always is.

    Raises:
        OutputError: The folder exists and may not be replaced, or it cannot be made.
    """
    target = _target(path, ours, overwrite=overwrite)
    with writing(path), temporary(target, Path.mkdir) as made:
        with shown_as({str(made): str(path)}):
            yield made
        # Checked again: minutes may have passed since the first check.
        _take_place(made, _target(path, ours, overwrite=overwrite), ours)


def move_folder(folder: Path, path: Path, ours: Ours, *, overwrite: bool = False) -> None:
    """Move a finished folder to its final path, across file systems if necessary.

    Args:
        folder: The folder to move.
        path: Its new path.
        ours: Lists the files of an existing folder that may be deleted.
        overwrite: Whether an existing folder may be replaced; an empty one always is.

    Raises:
        OutputError: As for `atomic_folder`; the folder is then still where it was.
    """
    target = _target(path, ours, overwrite=overwrite)
    if folder.stat().st_dev == target.parent.stat().st_dev:
        with writing(path):
            _take_place(folder, target, ours)
        return
    with atomic_folder(path, ours, overwrite=overwrite) as made:
        # File by file: copying the tree at once goes on after an error, and raises a list of all.
        for name in _contents(folder):
            (made / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(folder / name, made / name)
    shutil.rmtree(folder)


def check_folder_writable(path: Path, ours: Ours, *, overwrite: bool = False) -> None:
    """Fail now if `atomic_folder` would fail later, short of a full disk.

    Raises:
        OutputError: As for `atomic_folder`.
    """
    target = _target(path, ours, overwrite=overwrite)
    with writing(path), temporary(target, Path.mkdir):
        pass


def _target(path: Path, ours: Ours, *, overwrite: bool) -> Path:
    """Resolve symbolic links, finish interrupted swaps, and check the target."""
    with writing(path):
        target = Path(os.path.realpath(path))
        _finish_swaps(target, ours)
        _check_target(path, target, ours, overwrite=overwrite)
        return target


def _check_target(path: Path, target: Path, ours: Ours, *, overwrite: bool) -> None:
    refuse_without_parent(path, target)
    if not target.exists():
        return
    if not target.is_dir():
        raise OutputError(f"{path} is a file; name a folder as the output.")
    if os.path.ismount(target):  # as of a container; the finished folder could not take its place
        raise OutputError(
            f"{path} is a mount point, which cannot be replaced; name a folder inside it, such as"
            f" {path / 'web'}."
        )
    if Path.cwd().is_relative_to(target):
        raise OutputError(f"{path} is the folder you are in; name another one as the output.")
    if not any(target.iterdir()):
        refuse_read_only(path, target)
        return
    known = ours(target)
    if known is None:
        raise OutputError(f"{path} holds files that nanogs did not make; choose another folder.")
    if not overwrite:
        raise ExistsError(f"{path} exists already")
    if foreign := sorted(set(_contents(target)) - known):
        raise OutputError(
            f"{path} also holds {foreign[0]!r}, which nanogs did not make; move it away or choose "
            "another folder."
        )
    for inner in (PurePosixPath(), *_folders(known)):  # files in each are going to be deleted
        if (target / inner).is_dir():
            refuse_read_only(path / inner, target / inner)


def _contents(folder: Path, prefix: str = "") -> Iterator[str]:
    """Yield relative paths of all files below a folder, and of empty folders; links as files."""
    for entry in folder.iterdir():
        if entry.is_symlink() or not entry.is_dir():
            yield prefix + entry.name
        elif any(entry.iterdir()):
            yield from _contents(entry, f"{prefix}{entry.name}/")
        else:
            yield f"{prefix}{entry.name}/"


def _take_place(made: Path, target: Path, ours: Ours) -> None:
    """Rename the folder; an existing target is first renamed and, at the end, deleted."""
    with defer_exit():
        _swap(made, target, ours)


def _swap(made: Path, target: Path, ours: Ours) -> None:
    if not target.exists():
        made.replace(target)
        return
    old = name_beside(target, ".old")
    with locked(target):
        keep_mode(made, target)
        target.replace(old)
        try:
            made.replace(target)
        except BaseException:
            old.replace(target)
            raise
        _discard(old, ours)


def _finish_swaps(target: Path, ours: Ours) -> None:
    """Finish the swaps of runs that were killed while they replaced the target folder."""
    for old in left_beside(target, ".old"):
        if target.exists():
            with contextlib.suppress(OSError):  # what cannot be deleted must not block the output
                _discard(old, ours)
        else:
            old.replace(target)


def _discard(old: Path, ours: Ours) -> None:
    """Delete a folder file by file, not as a tree: files added meanwhile are not ours.

    Manifests are deleted last, so that the rest is still known to be ours if this is interrupted.
    """
    names = ours(old) or frozenset()
    for name in sorted(names, key=lambda name: (name.endswith(".json"), -name.count("/"))):
        (old / name).unlink(missing_ok=True)
    for folder in sorted(_folders(names), key=lambda folder: -len(folder.parts)):
        with contextlib.suppress(FileNotFoundError):
            (old / folder).rmdir()
    old.rmdir()


def _folders(names: Iterable[str]) -> set[PurePosixPath]:
    """Return the folders that files are in, as relative paths; not the one that holds them all."""
    return {parent for name in names for parent in PurePosixPath(name).parents if parent.parts}


def make_folders(folder: Path) -> list[Path]:
    """Create a folder with its parents, and return those that were missing, innermost first.

    Raises:
        OSError: It cannot be created; none of them is left.
    """
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        remove_empty(missing)
        raise
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders, given innermost first; those that are not empty stay."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
