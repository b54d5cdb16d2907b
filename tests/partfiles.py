"""Files opened to be read in parts, whatever their format, for tests."""

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from nanogs import io
from nanogs.io.parts import Packed, Whole
from nanogs.pipeline.tasks.unpack import NOTES, Unpacked, streamed
from nanogs.store.scratch import FolderScratch
from nanogs.store.tables import write_table


@contextmanager
def in_parts(path):
    """Yield a reader of a file's rows; its columns are unpacked first, where they must be."""
    with io.open(path) as source:
        assert not isinstance(source, Whole), f"{path} is not read in parts"
        if not isinstance(source, Packed):
            yield lambda start, stop: replace(source.read(start, stop), elements=())
            return
        with TemporaryDirectory() as folder:
            scratch, notes = FolderScratch(Path(folder)), []
            record = write_table(scratch, "u", streamed(source, notes), {NOTES: notes})
            Unpacked(scratch, {0: record}).give(0, source)
            yield lambda start, stop: replace(source.read(start, stop), elements=())
            source.close()  # before its columns are gone


def whole(path):
    """The splats of a file, without what is no row of theirs."""
    return replace(io.load(path), elements=())
