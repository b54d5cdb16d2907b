"""The table of formats, which brings the readers and writers of all; ask `registry` for one."""

from nanogs.io import (
    checkpoint,
    compressed_ply_write,
    gltf,
    gltf_write,
    ksplat,
    npz,
    npz_packed,
    ply,
    ply_write,
    sog,
    sog_levels,
    sog_packed,
    sog_write,
    splat,
    spz,
    spz_write,
    usda_write,
)
from nanogs.io.format import Format, WriteOption, unread
from nanogs.io.registry import LEVELS

_SPZ_FRAME = (
    "not stated in the file; y up (rub) by the specification, though many files have y down (rdf)"
)
_GLTF_FRAME = "y up (luf) in the file, turned to y down (rdf) when read"
_USD_FRAME = "y up in the file, by a transform; the model's own y is taken to be down (rdf)"


# Both PLY layouts share a reader: the header tells them apart, whatever the file is called.
FORMATS = (
    Format(
        ".compressed.ply",
        ply.read,
        ply.inspect,
        compressed_ply_write.write,
        compressed_ply_write.file_bytes,
        compressed_ply_write.losses,
        ply.stream,
        ply.rows,
        ply.packed,
    ),
    Format(
        ".ply",
        ply.read,
        ply.inspect,
        ply_write.write,
        ply_write.file_bytes,
        stream=ply.stream,
        rows=ply.rows,
        packed=ply.packed,
    ),
    Format(
        ".splat",
        splat.read,
        splat.inspect,
        splat.write,
        splat.file_bytes,
        losses=splat.losses,
        rows=splat.rows,
    ),
    Format(
        ".npz",
        npz.read,
        npz.inspect,
        npz.write,
        npz.file_bytes,
        losses=npz.losses,
        packed=npz_packed.packed,
    ),
    Format(
        ".spz",
        spz.read,
        spz.inspect,
        spz_write.write,
        losses=spz_write.losses,
        packed=spz.packed,
        frame=_SPZ_FRAME,
        axes=None,
        options={"spz_version": WriteOption("version", (2, 3, 4))},
    ),
    Format(".ksplat", ksplat.read, ksplat.inspect, rows=ksplat.rows),
    Format(
        ".glb",
        gltf.read,
        gltf.inspect,
        gltf_write.write,
        gltf_write.file_bytes,
        gltf_write.losses,
        rows=gltf.rows,
        frame=_GLTF_FRAME,
        turns=True,
    ),
    Format(
        ".gltf",
        gltf.read,
        gltf.inspect,
        rows=gltf.rows,
        files=gltf.files,
        frame=_GLTF_FRAME,
        turns=True,
    ),
    Format(
        ".sog",
        sog.read,
        sog.inspect,
        sog_write.write,
        losses=sog_write.losses,
        packed=sog_packed.packed,
        leaps=sog_write.leaps,
    ),
    Format(
        ".usda",
        unread,
        unread,
        usda_write.write,
        losses=usda_write.losses,
        frame=_USD_FRAME,
        turns=True,
    ),
    Format(".pt", checkpoint.read, checkpoint.inspect, frame=checkpoint.FRAME, axes=None),
    Format(".ckpt", checkpoint.read, checkpoint.inspect, frame=checkpoint.FRAME, axes=None),
    Format(
        "meta.json",
        sog.read,
        sog.inspect,
        losses=sog_write.losses,
        packed=sog_packed.packed,
        files=sog_packed.files,
        write_folder=sog_write.write_folder,
        ours=sog_write.ours,
    ),
    Format(
        LEVELS,
        sog_levels.read,
        sog_levels.inspect,
        read_level=sog_levels.read_level,
        level_counts=sog_levels.level_counts,
        packed=sog_packed.packed_level,
        files=sog_packed.level_files,
    ),
)
