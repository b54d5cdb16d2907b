"""Reading and writing scene files; the format follows from the suffix of the name."""

from os import PathLike
from pathlib import Path

from nanogs.errors import OptionError
from nanogs.io import atomic, registry
from nanogs.io.folder import check_folder_writable
from nanogs.io.info import FileInfo
from nanogs.splats import Splats

__all__ = ["FileInfo", "check_writable", "inspect", "load", "losses", "save"]


def load(path: str | PathLike[str]) -> Splats:
    """Read a model from a file of any format that nanogs knows; of a streamed one the finest level.

    Raises:
        FormatError: The suffix is unknown, the file cannot be read, is damaged, or holds
            something that cannot be kept.
    """
    path = Path(path)
    return registry.reader(path).read(path)


def save(splats: Splats, path: str | PathLike[str], *, overwrite: bool = False) -> None:
    """Write a model to a file, which appears whole or not at all.

    `folder/meta.json` makes the folder of a SOG model; of a folder that exists, nothing is replaced
    but what nanogs made.

    Raises:
        ModelError: The format cannot hold the model at all.
        OptionError: nanogs does not write the format that the suffix stands for.
        OutputError: The file or folder exists and `overwrite` is off, or it cannot be written.
    """
    path = Path(path)
    known = registry.writable(path)
    if known.write_folder:
        known.write_folder(splats, _folder_of(path, known), overwrite=overwrite)
    elif known.write:
        with atomic.atomic_write(path, overwrite=overwrite) as file:
            known.write(splats, file)


def losses(splats: Splats, path: str | PathLike[str]) -> tuple[str, ...]:
    """What `save` would leave out, one sentence each; quantisation, which a format implies, is not.

    Raises:
        OptionError: As for `save`.
    """
    return registry.losses(Path(path), splats)


def inspect(path: str | PathLike[str]) -> FileInfo:
    """Describe a scene file without reading its body.

    Raises:
        FormatError: As for `load`, except for what only the rows show.
    """
    path = Path(path)
    return registry.reader(path).inspect(path)


def check_writable(path: str | PathLike[str], *, overwrite: bool = False) -> None:
    """Fail before any computing if `save` could not write to `path`.

    Raises:
        OptionError: As for `save`.
        OutputError: As for `save`, except for a full disk.
    """
    path = Path(path)
    known = registry.writable(path)
    if known.ours:
        check_folder_writable(_folder_of(path, known), known.ours, overwrite=overwrite)
    else:
        atomic.check_writable(path, overwrite=overwrite)


def _folder_of(path: Path, known: registry.Format) -> Path:
    """The folder that a file describes.

    Raises:
        OptionError: The file is not called what the format has it called.
    """
    if path.name != known.suffix:
        raise OptionError(
            f"{path}: the file that describes a folder is called {known.suffix}; name it"
            f" {path.parent / path.stem / known.suffix}."
        )
    return path.parent
