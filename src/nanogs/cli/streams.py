"""`-` instead of a file: a model from stdin or to stdout.

Readers need files that they can map and seek in, so stdin is copied to a temporary file first.
"""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from nanogs.cleanup import temporary_folder
from nanogs.cli.blocks import DASH
from nanogs.cli.fetching import transfer_bar
from nanogs.errors import OptionError, OutputError, shown_as
from nanogs.io import registry
from nanogs.io.collect import Pair
from nanogs.io.url_files import MANIFESTS, TransferProgress, detect_suffix, local_copies
from nanogs.io.urls import Address, UrlFile

_REMEDY = "name it, as in --from splat"


@dataclass(frozen=True, slots=True)
class Streams:
    """The requested formats of stdin and stdout, which are replaced by temporary files.

    Attributes:
        read_as: Format of stdin or of a URL, with or without the dot; None to detect it.
        write_as: Format of stdout; None for the format of the input.
    """

    read_as: str | None = None
    write_as: str | None = None

    def check(self, pair: Pair) -> None:
        """Refuse format options for streams that are not used, terminals, and a closed stdin.

        Raises:
            OptionError: There is such an option or stream.
        """
        for option, given, path, place in (
            ("--from", self.read_as, pair.source, "IN"),
            ("--to", self.write_as, pair.target, "OUT"),
        ):
            by_url = place == "IN" and isinstance(path, Address | UrlFile)
            if given is not None and path != DASH and not by_url:
                raise OptionError(
                    f"{option} works only if {place} is -; {_instead(path, place, given)}."
                )
        if pair.source == DASH and (sys.stdin is None or sys.stdin.isatty()):
            what = "closed" if sys.stdin is None else "a terminal"
            raise OptionError(f"IN is - and stdin is {what}; pipe a model into it.")
        if pair.target == DASH and sys.stdout.isatty():
            raise OptionError("OUT is - and stdout is a terminal; redirect it to a file or pipe.")

    @contextmanager
    def opened(self, pair: Pair) -> Iterator[Pair]:
        """Replace streams by temporary files; the output is copied to stdout at the end.

        Raises:
            NanogsError: A format is unknown, stdin holds nothing, or what the block raises.
        """
        self.check(pair)
        if DASH not in (pair.source, pair.target):
            yield pair
            return
        with temporary_folder("nanogs-") as folder:
            with shown_as({f"{folder}{os.sep}": ""}):
                real = self._stand_ins(pair, folder)
                yield real
            if pair.target == DASH and real.target.exists():
                with real.target.open("rb") as file:
                    shutil.copyfileobj(file, sys.stdout.buffer)
                sys.stdout.buffer.flush()

    @contextmanager
    def received(self, source: Path, *, quiet: bool) -> Iterator[Path]:
        """Replace stdin or a URL by a temporary file; other paths are yielded unchanged.

        Args:
            source: The path, URL or `-` to read.
            quiet: Do not show the progress of a download.

        Raises:
            NanogsError: As for `opened`.
        """
        pair = Pair(source, Path("none"))
        with self.local_copies(pair, transfer_bar(quiet=quiet)) as near, self.opened(near) as real:
            yield real.source

    @contextmanager
    def local_copies(
        self, pair: Pair, transfer: TransferProgress, *, overwrite: bool = False
    ) -> Iterator[Pair]:
        """Replace URLs by temporary files; the output is uploaded at the end.

        Args:
            pair: Input and output.
            transfer: Shows the progress of downloads and uploads.
            overwrite: Replace what exists at the output's URL.

        Raises:
            NanogsError: As for `nanogs.io.url_files`, and for options of streams that are not used.
        """
        self.check(pair)
        read_as = self.read_as if isinstance(pair.source, Address) else None
        with local_copies(
            [pair.source],
            pair.target,
            overwrite=overwrite,
            format=read_as,
            transfer=transfer,
            remedy=_REMEDY,
        ) as ([source], target):
            yield Pair(source, target or pair.target)

    def _stand_ins(self, pair: Pair, folder: Path) -> Pair:
        source, target = pair.source, pair.target
        if source == DASH:
            source = self._received(folder)
        if target == DASH:
            if self.write_as:
                registry.file_of(self.write_as)  # raises if it is not a format
                suffix = registry.suffix_of(self.write_as)
            else:
                suffix = _own_suffix(source)
            target = folder / f"stdout{suffix}"
            registry.writer(target)
        return Pair(source, target)

    def _received(self, folder: Path) -> Path:
        raw = folder / "stdin"
        try:
            with raw.open("xb") as file:
                shutil.copyfileobj(sys.stdin.buffer, file)
        except OSError as error:
            reason = error.strerror or str(error)
            place = f"a temporary file in {folder.parent}"
            raise OutputError(
                f"Cannot copy stdin to {place} ({reason}); free some space, or name a file"
                " instead of -."
            ) from error
        if not raw.stat().st_size:
            raise OptionError("stdin is empty; pipe a model into it.")
        suffix = detect_suffix(raw, "stdin", self.read_as, _REMEDY)
        if suffix.endswith((*MANIFESTS, registry.META)):
            raise OptionError(
                f"A {suffix.lstrip('.')} refers to other files of its folder, which stdin does not"
                " hold; name the file instead of -."
            )
        named = raw.with_name(f"stdin{suffix}")
        registry.reader(named)
        return raw.rename(named)


def _instead(path: Path, place: str, given: str) -> str:
    """Return the remedy if an option for streams is given for a file."""
    if registry.find(path) is not None:
        return f"leave it out, because the name of {path} states the format"
    if place == "IN":
        return f"pipe the file into it, as in - --from {given} < {path}"
    return f"name {path}{registry.suffix_of(given)}"


def _own_suffix(source: Path) -> str:
    known = registry.find(source)
    if known is None or known.write is None:
        raise OptionError(
            "nanogs cannot write the format of IN; choose another for OUT, as in --to ply."
        )
    return known.suffix
