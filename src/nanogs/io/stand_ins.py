"""URLs in place of files: what is read is fetched first, what is written is sent at the end.

Readers want files that they can map and seek in, and writers files that appear whole. So there is
a temporary file for each, which is called by its URL in whatever is said.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path, PurePosixPath

from nanogs.cleanup import temporary_folder
from nanogs.errors import FormatError, NanogsError, OptionError
from nanogs.io import registry
from nanogs.io.collect import FILES
from nanogs.io.files import TOLD_BY, refuse_stand_in
from nanogs.io.registry import sniff
from nanogs.io.transfer import check_absent, fetch, upload
from nanogs.io.urls import Address, StandIn
from nanogs.progress import Parts, untold

Telling = Callable[[str], AbstractContextManager[Parts]]
"""Begins "fetch" or "send"; what the block gets is told the bytes."""
# They name folders of files that name others, or need those beside them to be opened.
_MANIFESTS = (registry.LEVELS, registry.TILESET, FILES, ".lcc")


def tell_nobody(_stage: str) -> AbstractContextManager[Parts]:
    """Stand in for `Telling` where nobody listens."""
    return nullcontext(untold)


@contextmanager
def at_hand(
    inputs: Sequence[Path],
    output: Path | None = None,
    *,
    overwrite: bool = False,
    format: str | None = None,  # noqa: A002 - as `load` has it
    telling: Telling = tell_nobody,
    remedy: str = 'name it, as in nanogs.load(url, format=".splat")',
) -> Iterator[tuple[list[Path], Path | None]]:
    """Files in place of addresses; other paths as they are.

    What the block has written for an address is sent there once it ends without an exception.

    Args:
        inputs: What is read.
        output: What is written, or None.
        overwrite: Replace what is there.
        format: Suffix of the inputs' format; by default that of their names, or what their first
            bytes show.
        telling: Shows what is fetched and sent.
        remedy: What to do where nothing shows the format of an input.

    Yields:
        The inputs and the output.

    Raises:
        NanogsError: One cannot be read or written, or what the block raises, about the addresses.
    """
    if not any(isinstance(path, Address) for path in (*inputs, output)):
        yield list(inputs), output
        return
    if isinstance(output, Address):
        check_sendable(output, overwrite=overwrite, format=format if not inputs else None)
    with temporary_folder("nanogs-") as folder:
        places: dict[str, str] = {}
        try:
            real = [_fetched(each, folder, places, format, telling, remedy) for each in inputs]
            target = _to_send(output, folder, places) if isinstance(output, Address) else output
            yield real, target
        except NanogsError as error:  # which may name a folder the user has never seen
            error.args = tuple(_renamed(str(part), places) for part in error.args)
            raise
        if isinstance(output, Address) and target is not None and target.exists():
            with telling("send") as tell:
                upload(target, output, tell, overwrite=overwrite)


def check_sendable(
    output: Address,
    *,
    overwrite: bool,
    format: str | None = None,  # noqa: A002 - as `save` has it
) -> None:
    """Refuse a URL that no file can be sent to, before anything is computed.

    Args:
        output: The URL.
        overwrite: Whether what is there may be replaced.
        format: Suffix of the format; by default that of its name.

    Raises:
        OptionError: nanogs does not write the format, or as one file; or not to such a URL.
        OutputError: Something is there and `overwrite` is off, or the store refuses.
    """
    if format is None and registry.writable(output).write is None:
        raise OptionError(
            f"{output} describes a folder of files; name one file, such as scene.sog."
        )
    check_absent(output, overwrite=overwrite)


def refuse_address(path: Path, remedy: str) -> None:
    """Refuse a URL where there has to be a file or folder.

    Args:
        path: What is given.
        remedy: What to do in its place.

    Raises:
        OptionError: It is a URL.
    """
    if isinstance(path, Address):
        raise OptionError(f"{path} is a URL; {remedy}.")


def suffix_told(raw: Path, called: str, format: str | None, remedy: str) -> str:  # noqa: A002
    """The suffix of what came without a name: the one given, or what the first bytes show.

    Args:
        raw: The file.
        called: What it is called in messages.
        format: As given, or None.
        remedy: What to do where nothing shows it.

    Raises:
        FormatError: Something else lies in its place, such as a web page.
        OptionError: Nothing shows the format.
    """
    suffix = registry.suffix_of(format) if format else sniff(raw)
    if suffix is None:
        with raw.open("rb") as file:
            refuse_stand_in(StandIn(raw, called), file.read(TOLD_BY))
        raise OptionError(f"The first bytes of {called} are of no format that says so; {remedy}.")
    return suffix


def _to_send(output: Address, folder: Path, places: dict[str, str]) -> Path:
    return _stand_in(_own(folder, output, places) / output.name, output)


def _own(folder: Path, address: Address, places: dict[str, str]) -> Path:
    """A folder for the files of an address."""
    own = folder / str(len(places))
    own.mkdir()
    places[f"{own}{os.sep}"] = f"{str(address).rpartition('/')[0]}/"
    return own


def _stand_in(path: Path, address: Address) -> StandIn:
    return StandIn(path, str(address))


def _fetched(
    path: Path,
    folder: Path,
    places: dict[str, str],
    format: str | None,  # noqa: A002 - as `load` has it
    telling: Telling,
    remedy: str,
) -> Path:
    """The temporary file of an address, with all that it names."""
    if not isinstance(path, Address):
        return path
    if path.name.lower().endswith(_MANIFESTS):
        raise FormatError(
            f"{path} describes files of its folder, which are not fetched; download the whole"
            " folder and name that, or a stream in one file (.ssog, .rad)."
        )
    if format is None and (known := registry.find(path)) and not known.readable:
        known.open(path)  # which says so, before anything is fetched
    own = _own(folder, path, places)
    raw = own / path.name
    with telling("fetch") as tell:
        fetch(path, raw, tell)
    if format or registry.find(raw) is None:
        told = suffix_told(raw, str(path), format, remedy)
        raw = raw.rename(raw.with_name(f"{raw.name}{told}"))
    model = _stand_in(raw, path)
    for file in registry.reader(model).open(model).files[1:]:
        name = PurePosixPath(file.relative_to(own).as_posix())
        file.parent.mkdir(parents=True, exist_ok=True)
        with telling("fetch") as tell:
            fetch(path.beside(str(name)), file, tell)
    return model


def _renamed(text: str, places: dict[str, str]) -> str:
    for place, called in places.items():
        text = text.replace(place, called)
    return text
