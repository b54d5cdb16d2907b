"""The job folder: its manifest, and the lock that keeps a second run out.

The lock is the system's, on an open file: it goes with the process that holds it, however it ends.
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
from nanogs.pipeline.settings import VERSION, Settings

MANIFEST, LOCK, SCRATCH, RESULT = "job.json", "lock", "scratch", "result-"


def job_folder(output: Path, job: str | PathLike[str] | None) -> Path:
    """The job folder: the one named, or that beside the output.

    Raises:
        OutputError: There can be none of that name.
    """
    folder = output.with_name(f"{output.name}.job") if job is None else Path(job)
    try:
        folder.lstat()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass  # that is found out, and said, where it is made
    except OSError as error:
        raise OutputError(
            f"The folder {folder} cannot be made ({error.strerror}), in which a job in blocks keeps"
            " its files; name another one with `job`."
        ) from error
    return folder


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a job folder, which is made if missing; one without a manifest goes afterwards.

    Raises:
        OutputError: It cannot be made, is no job folder, or another run holds it.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder} is no folder; name another one for the job.")
        folder.mkdir(parents=True, exist_ok=True)
        _refuse_foreign(folder)
        file = (folder / LOCK).open("ab")
    except OSError as error:
        raise output_error(folder, error) from error
    with file:
        _take(file, folder)
        with cleaned_up(partial(_remove_unless_begun, folder)):
            yield


def _remove_unless_begun(folder: Path) -> None:
    """Take a job's folder away that holds no job."""
    if (folder / MANIFEST).exists():
        return
    with suppress(OSError):
        for path in folder.glob(f"{RESULT}*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        if (folder / SCRATCH).exists():
            (folder / SCRATCH).rmdir()
        (folder / LOCK).unlink()
        folder.rmdir()


def _refuse_foreign(folder: Path) -> None:
    if (folder / MANIFEST).exists():
        return
    others = (path.name for path in folder.iterdir() if not path.name.startswith(RESULT))
    if any(name not in (LOCK, SCRATCH) for name in others):
        raise OutputError(f"{folder} holds other files; name a new folder for the job.")


def _take(file: BinaryIO, folder: Path) -> None:
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # A run that ended just now may have taken the file away from under the name.
        if not os.path.samestat(os.fstat(file.fileno()), (folder / LOCK).stat()):
            raise OSError
    except OSError:
        raise OutputError(
            f"Another run is at work in {folder}; wait for it, or name another folder with `job`."
        ) from None


def write_manifest(folder: Path, settings: Settings, scratch: str) -> None:
    """Say what the job is.

    Args:
        folder: Of the job.
        settings: What decides its result.
        scratch: The folder or URL of its intermediate files.

    Raises:
        OutputError: It cannot be written.
    """
    text = json.dumps({"settings": settings.to_dict(), "scratch": scratch}, indent=1)
    with atomic_write(folder / MANIFEST, overwrite=True) as file:
        file.write(text.encode())


def read_manifest(folder: Path) -> tuple[dict[str, Any], str] | None:
    """The settings, as plain data, and the scratch of the job in a folder; None without a job.

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
    """Say that there is nothing to resume, where an output stands without a job folder.

    Raises:
        OutputError: It is so.
    """
    empty = output.is_dir() and not any(output.iterdir())
    if output.exists() and not empty and not (folder / MANIFEST).exists():
        raise ExistsError(
            f"{output} exists and {folder} holds no job: one that ended well leaves nothing to"
            " resume",
            "make it anew",
        )


def forget(folder: Path) -> None:
    """Take away the manifest; the rest goes with the lock."""
    (folder / MANIFEST).unlink(missing_ok=True)
