"""The metadata of a scene file, read without its body."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nanogs.source import Layout
from nanogs.splats import RenderMode

_TYPES = {
    "char": "|i1", "uchar": "|u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "float": "<f4", "double": "<f8",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class FileInfo:
    """The metadata of a scene file.

    Attributes:
        path: The file.
        format: Name of the format: its suffix without the first dot, `sog` for `meta.json` too,
            `streamed sog`, `3d tiles` or `checkpoint`.
        encoding: `binary_little_endian`, `binary_big_endian` or `ascii`; usually `gzip` or `zstd`
            for a `.spz` file, `deflate` for a `.rad` file, `zip` for a `.npz` file or a checkpoint,
            `webp` for SOG.
        file_bytes: Size of the file, or of all files that make up the model, in bytes.
        splats: Number of splats.
        sh_degree: Degree of the spherical harmonics, 0 to 4.
        double_means: Whether the centres are stored in double precision.
        properties: (name, type) of each stored column of a splat, in the file's order; the type is
            PLY's name, or NumPy's (`float16`, `<U4`) if PLY has none; `int24` is `.spz`'s own.
        extras: Names of the columns nanogs carries through without interpreting them.
        elements: (name, rows) of each PLY element besides those that make up the splats.
        render_mode: The rasteriser the model was trained for.
        render_tag: The part of the file that states the render mode, such as `the comment
            "antialiased 1"`; empty if there is none and the default is assumed.
        comments: Comment lines, printable; bytes that are not UTF-8 are shown as Latin-1.
    """

    path: Path
    format: str
    encoding: str
    file_bytes: int
    splats: int
    sh_degree: int
    double_means: bool = False
    properties: tuple[tuple[str, str], ...] = ()
    extras: tuple[str, ...] = ()
    elements: tuple[tuple[str, int], ...] = ()
    render_mode: RenderMode = RenderMode.DEFAULT
    render_tag: str = ""
    comments: tuple[str, ...] = ()

    @property
    def layout(self) -> Layout:
        """The columns that the model has when it is read."""
        types = dict(self.properties)
        kinds = {name: _TYPES.get(types[name]) or np.dtype(types[name]).str for name in self.extras}
        return Layout(
            sh_degree=self.sh_degree,
            double_means=self.double_means,
            extras=tuple(kinds.items()),
            render_mode=self.render_mode.value,
            comments=self.comments,
        )

    def extra_bytes(self) -> int:
        """Compute the number of bytes that the extra columns take for each splat."""
        return sum(np.dtype(kind).itemsize for _, kind in self.layout.extras)
