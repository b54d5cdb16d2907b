"""Files opened to be read in parts, whatever their format, for tests."""

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from nanogs import io
from nanogs.io import registry
from nanogs.scale.scratch import FolderScratch
from nanogs.scale.tables import write_table
from nanogs.scale.unpack import NOTES, Unpacked, streamed


@contextmanager
def in_parts(path):
    """What reads rows of a file; its columns are unpacked first, where they must be."""
    known = registry.find(path)
    rows = known.rows(path)
    if rows is not None:
        yield rows.read
        return
    packed = known.packed(path)
    assert packed is not None, f"{path} is not read in parts"
    with TemporaryDirectory() as folder:
        scratch, notes = FolderScratch(Path(folder)), []
        record = write_table(scratch, "u", streamed(packed, notes), {NOTES: notes})
        with Unpacked(scratch, {0: record}).opened(0, packed) as read:
            yield read


def whole(path):
    """The splats of a file, without what is no row of theirs."""
    return replace(io.load(path), elements=())
