"""`.ply` files of splats, plain or in PlayCanvas' compressed layout, which the header shows."""

from nanogs.io.format import Format
from nanogs.io.ply import compressed_write, write
from nanogs.io.ply.read import open_ply

_STARTS = (b"ply\n", b"ply\r\n")
FORMATS = (
    Format(
        ".compressed.ply",
        open_ply,
        compressed_write.write,
        compressed_write.file_bytes,
        compressed_write.losses,
        streams=True,
        max_degree=compressed_write.MAX_DEGREE,
        rounds=True,
    ),
    Format(
        ".ply",
        open_ply,
        write.write,
        write.file_bytes,
        streams=True,
        any_value=True,
        check_columns=write.check_columns,
        magic=_STARTS,
    ),
)
