"""The table of formats, which brings the readers and writers of all; ask `registry` for one."""

from functools import partial

from nanogs.io import html as html_write
from nanogs.io import splat
from nanogs.io.checkpoint import read as checkpoint
from nanogs.io.compressed_ply import write as compressed_ply_write
from nanogs.io.format import Format, WriteOption, unread
from nanogs.io.gltf import read as gltf
from nanogs.io.gltf import tileset
from nanogs.io.gltf import write as gltf_write
from nanogs.io.ksplat import read as ksplat
from nanogs.io.npz import write as npz_write
from nanogs.io.npz.read import NpzFile
from nanogs.io.parts import Whole
from nanogs.io.ply import read as ply
from nanogs.io.ply import write as ply_write
from nanogs.io.registry import LEVELS, TILESET
from nanogs.io.sog import packed as sog_packed
from nanogs.io.sog import write as sog_write
from nanogs.io.spz import read as spz
from nanogs.io.spz import write as spz_write
from nanogs.io.usda import read as usda
from nanogs.io.usda import write as usda_write

_SPZ_FRAME = (
    "not stated in the file; y up (rub) by the specification, though many files have y down (rdf)"
)
_GLTF_FRAME = "y up (luf) in the file, turned to y down (rdf) when read"
_TILES_FRAME = "z up in the tileset, turned to y down (rdf) when read"
_USD_FRAME = "y up or z up as the file says, turned to y down (rdf) when read"


# Both PLY layouts share a reader: the header tells them apart, whatever the file is called.
FORMATS = (
    Format(
        ".compressed.ply",
        ply.open_ply,
        compressed_ply_write.write,
        compressed_ply_write.file_bytes,
        compressed_ply_write.losses,
        streams=True,
    ),
    Format(".ply", ply.open_ply, ply_write.write, ply_write.file_bytes, streams=True),
    Format(".splat", splat.SplatFile, splat.write, splat.file_bytes, splat.losses, streams=True),
    Format(".npz", NpzFile, npz_write.write, npz_write.file_bytes, npz_write.losses, streams=True),
    Format(
        ".spz",
        spz.open_spz,
        spz_write.write,
        losses=spz_write.losses,
        frame=_SPZ_FRAME,
        axes=None,
        options={"spz_version": WriteOption("version", (2, 3, 4))},
        streams=True,
    ),
    Format(".ksplat", ksplat.KsplatFile),
    Format(
        ".glb",
        gltf.open_gltf,
        gltf_write.write,
        gltf_write.file_bytes,
        gltf_write.losses,
        frame=_GLTF_FRAME,
        turns=True,
    ),
    Format(".gltf", gltf.open_gltf, frame=_GLTF_FRAME, turns=True),
    Format(
        ".sog",
        sog_packed.SogSource,
        sog_write.write,
        tells=True,
        losses=sog_write.losses,
        leaps=sog_write.leaps,
    ),
    Format(
        ".usda",
        partial(Whole, inspect=usda.inspect, read=usda.read),
        usda_write.write,
        losses=usda_write.losses,
        frame=_USD_FRAME,
        turns=True,
    ),
    Format(".html", unread, html_write.write, losses=html_write.losses, check=html_write.check),
    *(
        Format(
            suffix,
            partial(Whole, inspect=checkpoint.inspect, read=checkpoint.read),
            frame=checkpoint.FRAME,
            axes=None,
        )
        for suffix in (".pt", ".ckpt", ".pth")
    ),
    Format(
        "meta.json",
        sog_packed.SogSource,
        losses=sog_write.losses,
        write_folder=sog_write.write_folder,
        ours=sog_write.ours,
    ),
    Format(LEVELS, sog_packed.open_level, open_level=sog_packed.open_level),
    Format(
        TILESET,
        tileset.open_level,
        open_level=tileset.open_level,
        frame=_TILES_FRAME,
        turns=True,
    ),
)
