"""Reading files of any format in parts, for tests."""

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
    """Yield a function that reads a range of rows; packed formats are unpacked to files first."""
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
            source.close()  # before the files of its columns are deleted


def load_whole(path):
    """Read all splats of a file, without its extra elements."""
    return replace(io.load(path), elements=())
