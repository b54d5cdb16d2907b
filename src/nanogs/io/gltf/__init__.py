"""glTF with KHR_gaussian_splatting, and 3D Tiles, whose tile contents are glTF files."""

from functools import partial

from nanogs.io.format import Format
from nanogs.io.gltf import tileset, write
from nanogs.io.gltf.glb import MAGIC
from nanogs.io.gltf.primitives import MAX_DEGREE
from nanogs.io.gltf.read import named_files, open_gltf
from nanogs.io.registry import TILESET

_FRAME = "y up (luf) in the file, turned to y down (rdf) when read"
_TILES_FRAME = "z up in the tileset, turned to y down (rdf) when read"
FORMATS = (
    Format(
        ".glb",
        open_gltf,
        write.write,
        write.file_bytes,
        write.losses,
        frame=_FRAME,
        turns=True,
        streams=True,
        max_degree=MAX_DEGREE,
        magic=(MAGIC,),
        named_files=named_files,
    ),
    Format(
        ".gltf",
        open_gltf,
        write.write_text,
        write.text_bytes,
        partial(write.losses, suffix=".gltf"),
        frame=_FRAME,
        turns=True,
        streams=True,
        max_degree=MAX_DEGREE,
        named_files=named_files,
    ),
    Format(
        TILESET,
        tileset.open_level,
        open_level=tileset.open_level,
        frame=_TILES_FRAME,
        turns=True,
    ),
)
