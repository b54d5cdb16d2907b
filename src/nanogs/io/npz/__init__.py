"""`.npz`: the arrays of a model, unchanged, for NumPy."""

from nanogs.io.format import Format
from nanogs.io.npz import write
from nanogs.io.npz.read import NpzFile

FORMATS = (
    Format(
        ".npz",
        NpzFile,
        write.write,
        write.file_bytes,
        write.losses,
        streams=True,
        any_value=True,
        check_columns=write.check_columns,
        zip_member="means.npy",
    ),
)
