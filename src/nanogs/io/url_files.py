"""Temporary files in place of URLs: inputs are downloaded first, outputs uploaded at the end.

Readers need files that they can map and seek in, and writers files that appear whole. So each URL
gets a temporary file, which is shown under its URL in all messages.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path, PurePosixPath

from nanogs.cleanup import temporary_folder
from nanogs.errors import FormatError, OptionError, shown_as
from nanogs.io import registry
from nanogs.io.files import HEAD_BYTES, refuse_stand_in
from nanogs.io.registry import sniff
from nanogs.io.transfer import check_absent, fetch, upload
from nanogs.io.urls import Address, UrlFile
from nanogs.progress import PartProgress, ignore_progress

TransferProgress = Callable[[str], AbstractContextManager[PartProgress]]
"""Context manager of the stage "fetch" or "send"; yields a callback for the bytes transferred."""
# Manifests whose model cannot be downloaded file by file: their files name further files, or have
# to be there before the manifest can be opened.
MANIFESTS = (registry.LEVELS, registry.TILESET, registry.LEVEL_LIST, ".lcc", ".lcc2")


def no_transfer_progress(_stage: str) -> AbstractContextManager[PartProgress]:
    """Report no progress: a `TransferProgress` for callers without a progress display."""
    return nullcontext(ignore_progress)


@contextmanager
def local_copies(
    inputs: Sequence[Path],
    output: Path | None = None,
    *,
    overwrite: bool = False,
    format: str | None = None,  # noqa: A002 - the name in `load`
    transfer: TransferProgress = no_transfer_progress,
    remedy: str = 'name it, as in nanogs.load(url, format=".splat")',
) -> Iterator[tuple[list[Path], Path | None]]:
    """Replace each URL by the path of a temporary file; other paths are returned unchanged.

    Inputs are downloaded first. If the output is a URL, the file that the block has written is
    uploaded once the block ends without an exception.

    Args:
        inputs: Paths or URLs to read.
        output: Path or URL to write, or None.
        overwrite: Replace a file that exists at the output.
        format: Suffix of the inputs' format; by default taken from their names or detected from
            their first bytes.
        transfer: Reports the progress of downloads and uploads.
        remedy: Advice for the error message if the format of an input cannot be detected.

    Yields:
        The local paths of the inputs and of the output.

    Raises:
        NanogsError: A file cannot be read or written, or the block raises one; in its message, the
            paths of the temporary files are replaced by the URLs.
    """
    if not any(isinstance(path, Address) for path in (*inputs, output)):
        yield list(inputs), output
        return
    if isinstance(output, Address):
        check_sendable(output, overwrite=overwrite, format=format if not inputs else None)
    with temporary_folder("nanogs-") as folder:
        places: dict[str, str] = {}
        with shown_as(places):
            real = [_fetched(each, folder, places, format, transfer, remedy) for each in inputs]
            target = _to_send(output, folder, places) if isinstance(output, Address) else output
            yield real, target
        if isinstance(output, Address) and target is not None and target.exists():
            with transfer("send") as on_progress:
                upload(target, output, on_progress, overwrite=overwrite)


def check_sendable(
    output: Address,
    *,
    overwrite: bool,
    format: str | None = None,  # noqa: A002 - the name in `save`
) -> None:
    """Refuse a URL that no file can be uploaded to, before anything is computed.

    Args:
        output: The URL.
        overwrite: Whether a file that exists there may be replaced.
        format: Suffix of the format; by default that of the URL's name.

    Raises:
        OptionError: nanogs does not write the format, does not write it as a single file, or does
            not write to this kind of URL.
        OutputError: A file exists there and `overwrite` is off, or the store refuses.
    """
    if format is None and registry.writable(output).write is None:
        raise OptionError(
            f"{output} describes a folder of files; name one file, such as scene.sog."
        )
    check_absent(output, overwrite=overwrite)


def refuse_address(path: Path, remedy: str) -> None:
    """Refuse a URL where a local file or folder is required.

    Args:
        path: The path or URL that was given.
        remedy: Advice for the error message.

    Raises:
        OptionError: It is a URL.
    """
    if isinstance(path, Address):
        raise OptionError(f"{path} is a URL; {remedy}.")


def detect_suffix(raw: Path, called: str, format: str | None, remedy: str) -> str:  # noqa: A002
    """Return the suffix of a file without a useful name: as given, or detected from its bytes.

    Args:
        raw: The file.
        called: Name of the file in messages.
        format: The format that was given, or None.
        remedy: Advice for the error message if the format cannot be detected.

    Raises:
        FormatError: The file is a web page or a Git LFS pointer, nanogs does not read the format,
            or the file begins like one of another.
        OptionError: The format cannot be detected.
    """
    if format:
        named = registry.file_of(format, to_read=True)  # raises if it is not a format
        registry.refuse_misnamed(raw, registry.reader(named), called)
    suffix = registry.suffix_of(format) if format else sniff(raw)
    if suffix is None:
        with raw.open("rb") as file:
            refuse_stand_in(UrlFile(raw, called), file.read(HEAD_BYTES))
        raise OptionError(f"The first bytes of {called} do not show its format; {remedy}.")
    return suffix


def _to_send(output: Address, folder: Path, places: dict[str, str]) -> Path:
    return UrlFile(_own(folder, output, places) / output.name, str(output))


def _own(folder: Path, address: Address, places: dict[str, str]) -> Path:
    """Make a temporary folder for the files of a URL and record it in `places`."""
    own = folder / str(len(places))
    own.mkdir()
    places[f"{own}{os.sep}"] = f"{str(address).rpartition('/')[0]}/"
    return own


def _fetched(
    path: Path,
    folder: Path,
    places: dict[str, str],
    format: str | None,  # noqa: A002 - the name in `load`
    transfer: TransferProgress,
    remedy: str,
) -> Path:
    """Download the file of a URL, and the files that it refers to; other paths are unchanged."""
    if not isinstance(path, Address):
        return path
    if path.name.lower().endswith(MANIFESTS):
        raise FormatError(
            f"{path} refers to other files of its folder, which nanogs does not download; download"
            " the whole folder and name that, or use a stream in one file (.ssog, .rad)."
        )
    if format is None and (known := registry.find(path)) and not known.readable:
        known.open(path)  # raises for a format that is only written, before the download
    own = _own(folder, path, places)
    raw = own / path.name
    with transfer("fetch") as on_progress:
        fetch(path, raw, on_progress)
    if format or registry.find(raw) is None:
        suffix = detect_suffix(raw, str(path), format, remedy)
        raw = raw.rename(raw.with_name(f"{raw.name}{suffix}"))
    model = UrlFile(raw, str(path))
    for file in registry.reader(model).named_files(model):
        name = PurePosixPath(file.relative_to(own).as_posix())
        file.parent.mkdir(parents=True, exist_ok=True)
        with transfer("fetch") as on_progress:
            fetch(path.beside(str(name)), file, on_progress)
    return model
