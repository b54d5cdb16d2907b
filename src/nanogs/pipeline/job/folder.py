"""The job folder: its manifest, and the lock that keeps a second run out.

The lock is an operating-system lock on an open file, which is released however the process ends.
"""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from nanogs.cleanup import cleaned_up
from nanogs.errors import ExistsError, FormatError, OutputError
from nanogs.io.atomic import atomic_write, output_error
from nanogs.io.folder import make_folders, remove_empty
from nanogs.pipeline.options.settings import VERSION, Settings

MANIFEST, SCRATCH = "job.json", "scratch"
# The lock, and the results of a job until they are moved. No user chooses these names: the lock,
# and what has the second one, alone or with a suffix, are deleted with the job.
LOCK, RESULT = "lock-of-nanogs-job", "result-of-nanogs-job"


def job_folder(output: Path, job: str | PathLike[str] | None) -> Path:
    """Return the path of the job folder: the one named, or by default one beside the output.

    Raises:
        OutputError: A folder of that name is not possible.
    """
    folder = output.with_name(f"{output.name}.job") if job is None else Path(job)
    try:
        folder.lstat()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass  # these errors are reported where the folder is made
    except OSError as error:
        raise OutputError(
            f"Cannot create the folder {folder} for the files of the job ({error.strerror}); name"
            " another one with `job`."
        ) from error
    return folder


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a job folder, made if missing, and remove it afterwards if it has no manifest.

    Raises:
        OutputError: It cannot be made, is no job folder, or is locked by another run.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder} is not a folder; name another one for the job.")
        made = make_folders(folder)
        _refuse_foreign(folder)
        file = (folder / LOCK).open("a+b")
    except OSError as error:
        raise output_error(folder, error) from error
    with file:
        _lock(file, folder)
        with cleaned_up(partial(_remove_unless_begun, folder, _made_around(file, made))):
            yield


def _made_around(lock: BinaryIO, made: list[Path]) -> int:
    """Return how many folders around the job's this run or an earlier one made; the lock notes it.

    Args:
        lock: The lock, open and locked.
        made: What `make_folders` made for this run.
    """
    lock.seek(0)
    noted = lock.read()
    if made and not noted:
        noted = b"%d" % (len(made) - 1)
        lock.write(noted)
        lock.flush()
    return int(noted) if noted.isdigit() else 0


def _remove_unless_begun(folder: Path, around: int) -> None:
    """Remove a job folder that has no manifest, and `around` folders around it if empty."""
    if (folder / MANIFEST).exists():
        return
    with suppress(OSError):
        for path in filter(_is_result, list(folder.iterdir())):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        if (folder / SCRATCH).exists():
            (folder / SCRATCH).rmdir()
        (folder / LOCK).unlink()
        folder.rmdir()
        remove_empty(folder.parents[:around])


def _refuse_foreign(folder: Path) -> None:
    if (folder / MANIFEST).exists():
        return
    if not all(_is_own(path) for path in folder.iterdir()):
        raise OutputError(
            f"{folder} cannot be the folder of the job, because it holds other files; name a new"
            " one."
        )


def _is_own(path: Path) -> bool:
    """Whether a job without a manifest leaves this file or folder: its scratch is empty by then."""
    if path.name == SCRATCH:
        return path.is_dir() and not any(path.iterdir())
    return path.name == LOCK or _is_result(path)


def _is_result(path: Path) -> bool:
    """Whether a path is a result that was not moved, or belongs to one, such as the note on it."""
    return path.name == RESULT or path.name.startswith(f"{RESULT}.")


def _lock(file: BinaryIO, folder: Path) -> None:
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # A run that has just ended may have deleted the lock file after it was opened here.
        if not os.path.samestat(os.fstat(file.fileno()), (folder / LOCK).stat()):
            raise OSError
    except OSError:
        raise OutputError(
            f"Another run is at work in {folder}; wait for it, or name another folder with `job`."
        ) from None


def write_manifest(folder: Path, settings: Settings, scratch: str) -> None:
    """Write the manifest of a job.

    Args:
        folder: The job's folder.
        settings: The settings that determine its result.
        scratch: The folder or URL of its intermediate files.

    Raises:
        OutputError: It cannot be written.
    """
    text = json.dumps({"settings": settings.to_dict(), "scratch": scratch}, indent=1)
    with atomic_write(folder / MANIFEST, overwrite=True) as file:
        file.write(text.encode())


def read_manifest(folder: Path) -> tuple[dict[str, Any], str] | None:
    """Read the settings, as plain data, and the scratch of the job in a folder; None without one.

    Raises:
        FormatError: The manifest is damaged, or of another version.
    """
    try:
        data = json.loads((folder / MANIFEST).read_bytes())
        settings, scratch = dict(data["settings"]), str(data["scratch"])
        version, settings["block"] = settings["version"], int(settings["block"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(
            f"{folder / MANIFEST} cannot be read ({error}); remove the folder and begin anew."
        ) from None
    if version != VERSION:
        raise FormatError(
            "The job was begun by another version of nanogs; remove its folder and begin anew."
        )
    return settings, scratch


def refuse_finished(folder: Path, output: Path) -> None:
    """Raise if there is nothing to resume: the output exists, and there is no job folder.

    Raises:
        ExistsError: The output exists, and there is no job to resume.
    """
    empty = output.is_dir() and not any(output.iterdir())
    if output.exists() and not empty and not (folder / MANIFEST).exists():
        raise ExistsError(
            f"There is nothing to resume, because {output} exists and {folder} holds no job, as"
            " after a finished run",
            "make it anew",
        )


def forget(folder: Path) -> None:
    """Delete the manifest; the rest of the folder is removed when the lock is released."""
    (folder / MANIFEST).unlink(missing_ok=True)
