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
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.io import registry
from nanogs.io.collect import Pair
from nanogs.io.files import TOLD_BY, refuse_stand_in
from nanogs.io.registry import sniff


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
            if given is not None and path != DASH:
                raise OptionError(f"{option} is for {place} - alone; the name of {path} says it.")
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
    def received(self, source: Path) -> Iterator[Path]:
        """A file in place of stdin; other paths as they are.

        Raises:
            NanogsError: As for `opened`.
        """
        with self.opened(Pair(source, Path("none"))) as pair:
            yield pair.source

    def _stand_ins(self, pair: Pair, folder: Path) -> Pair:
        source, target = pair.source, pair.target
        if source == DASH:
            source = self._received(folder)
        if target == DASH:
            suffix = registry.suffix_of(self.write_as) if self.write_as else _own_suffix(source)
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
        suffix = registry.suffix_of(self.read_as) if self.read_as else sniff(raw)
        if suffix is None:
            with raw.open("rb") as file:
                refuse_stand_in(Path("stdin"), file.read(TOLD_BY))
            raise OptionError(
                "The first bytes of stdin are of no format that says so; name it, as in"
                " --from splat."
            )
        named = raw.with_name(f"stdin{suffix}")
        registry.reader(named)
        return raw.rename(named)


def _own_suffix(source: Path) -> str:
    known = registry.find(source)
    if known is None or known.write is None:
        raise OptionError("The format of IN is none that nanogs writes; add --to ply.")
    return known.suffix
