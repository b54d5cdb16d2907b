"""`-` in place of a file: a model from stdin, a model to stdout.

Readers want files that they can map and seek in, so what comes is put into a temporary one first.
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
from nanogs.cli.fetching import a_bar
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.io import registry
from nanogs.io.collect import Pair
from nanogs.io.stand_ins import TransferProgress, detect_suffix, local_copies
from nanogs.io.urls import Address, StandIn

_REMEDY = "name it, as in --from splat"


@dataclass(frozen=True, slots=True)
class Streams:
    """The formats of stdin and stdout as asked for, or None.

    Attributes:
        read_as: Of stdin, with or without its dot.
        write_as: Of stdout.
    """

    read_as: str | None = None
    write_as: str | None = None

    def check(self, pair: Pair) -> None:
        """Refuse options for streams that are not used, and terminals.

        Raises:
            OptionError: As said.
        """
        for option, given, path, place in (
            ("--from", self.read_as, pair.source, "IN"),
            ("--to", self.write_as, pair.target, "OUT"),
        ):
            by_url = place == "IN" and isinstance(path, Address | StandIn)
            if given is not None and path != DASH and not by_url:
                raise OptionError(
                    f"{option} is for {place} - alone; {_instead(path, place, given)}."
                )
        if pair.source == DASH and sys.stdin.isatty():
            raise OptionError("IN is - and stdin is a terminal; pipe a model into it.")
        if pair.target == DASH and sys.stdout.isatty():
            raise OptionError("OUT is - and stdout is a terminal; redirect it to a file or pipe.")

    @contextmanager
    def opened(self, pair: Pair) -> Iterator[Pair]:
        """Files in place of streams; what was written for stdout is sent there at the end.

        Raises:
            NanogsError: A format is unknown, stdin holds nothing, or what the block raises.
        """
        self.check(pair)
        if DASH not in (pair.source, pair.target):
            yield pair
            return
        with temporary_folder("nanogs-") as folder:
            try:
                real = self._stand_ins(pair, folder)
                yield real
            except NanogsError as error:  # which names a folder the user has never seen
                inside = f"{folder}{os.sep}"
                error.args = tuple(str(part).replace(inside, "") for part in error.args)
                raise
            if pair.target == DASH and real.target.exists():
                with real.target.open("rb") as file:
                    shutil.copyfileobj(file, sys.stdout.buffer)
                sys.stdout.buffer.flush()

    @contextmanager
    def received(self, source: Path, *, quiet: bool) -> Iterator[Path]:
        """A file in place of stdin or a URL; other paths as they are.

        Args:
            source: What is read.
            quiet: Show nothing of what is fetched.

        Raises:
            NanogsError: As for `opened`.
        """
        pair = Pair(source, Path("none"))
        with self.local_copies(pair, a_bar(quiet=quiet)) as near, self.opened(near) as real:
            yield real.source

    @contextmanager
    def local_copies(
        self, pair: Pair, telling: TransferProgress, *, overwrite: bool = False
    ) -> Iterator[Pair]:
        """Files in place of URLs; what was written for one is sent there at the end.

        Args:
            pair: What is read and written.
            telling: Shows what is fetched and sent.
            overwrite: Replace what is there.

        Raises:
            NanogsError: As for `nanogs.io.stand_ins`, and options for streams that are not used.
        """
        self.check(pair)
        read_as = self.read_as if isinstance(pair.source, Address) else None
        with local_copies(
            [pair.source],
            pair.target,
            overwrite=overwrite,
            format=read_as,
            telling=telling,
            remedy=_REMEDY,
        ) as ([source], target):
            yield Pair(source, target or pair.target)

    def _stand_ins(self, pair: Pair, folder: Path) -> Pair:
        source, target = pair.source, pair.target
        if source == DASH:
            source = self._received(folder)
        if target == DASH:
            if self.write_as:
                registry.file_of(self.write_as)  # which refuses what is no format
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
            raise OutputError(f"stdin cannot be put into {place} ({reason}).") from error
        if not raw.stat().st_size:
            raise OptionError("stdin is empty; pipe a model into it.")
        suffix = detect_suffix(raw, "stdin", self.read_as, _REMEDY)
        named = raw.with_name(f"stdin{suffix}")
        registry.reader(named)
        return raw.rename(named)


def _instead(path: Path, place: str, given: str) -> str:
    """The remedy where an option for streams is given for a file."""
    if registry.find(path) is not None:
        return f"the name of {path} says it"
    if place == "IN":
        return f"pipe the file into it, as in - --from {given} < {path}"
    return f"name {path}{registry.suffix_of(given)}"


def _own_suffix(source: Path) -> str:
    known = registry.find(source)
    if known is None or known.write is None:
        raise OptionError("The format of IN is none that nanogs writes; add --to ply.")
    return known.suffix
