"""Writing SOG, version 2: `.sog`, which is one zip, or `meta.json` in a folder of its files.

`encode` computes the textures. The zip stores these WebP files without compressing them again. The
same model gives the same bytes.
"""

import json
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import BinaryIO

from nanogs import parallel
from nanogs._types import I64, U8
from nanogs.io.container import plain_entry
from nanogs.io.folder import atomic_folder
from nanogs.io.generator import read_own
from nanogs.io.json_fields import is_plain
from nanogs.io.precision import Precision
from nanogs.io.registry import META
from nanogs.io.sog import texture
from nanogs.io.sog.encode import encode_model
from nanogs.io.sog.options import USUAL_BITS, USUAL_OPTIONS, SogOptions
from nanogs.io.sog.unstorable import refuse_unstorable
from nanogs.progress import PartProgress, ignore_progress
from nanogs.splats import Splats


def write(
    splats: Splats,
    file: BinaryIO,
    on_progress: PartProgress = ignore_progress,
    *,
    palette_size: int | None = None,
    bits: int = USUAL_BITS,
    sh_bits: int | None = None,
    spare: int | None = None,
) -> None:
    """Write a `.sog` file.

    Args:
        splats: The model.
        file: The file to write to.
        on_progress: Progress callback for computing the palette.
        palette_size: Largest number of entries of the palette of the higher coefficients, 1 to
            65,536; by default `USUAL_PALETTE`.
        bits: Bits of a component of a rotation, 4 to 8; all else follows, see `Precision`.
        sh_bits: Bits of the codes of the higher coefficients, 2 to 8; see `SogOptions`.
        spare: Bits that are dropped from centres, 0 to 6; by default the smaller the splats, the
            fewer.

    Raises:
        OutputError: A value is NaN, infinite or too large for a codebook, or there are too many
            splats for a texture; nothing has been written then.
    """
    options = SogOptions(palette_size, Precision(bits, spare), sh_bits)
    files = contents(splats, on_progress, options)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in files.items():
            bundle.writestr(plain_entry(name), data)


def write_folder(
    splats: Splats,
    path: Path,
    on_progress: PartProgress = ignore_progress,
    *,
    overwrite: bool = False,
    palette_size: int | None = None,
    bits: int = USUAL_BITS,
    sh_bits: int | None = None,
    spare: int | None = None,
) -> None:
    """Write `meta.json` and its textures to a folder, which appears whole or not at all.

    Args:
        splats: The model.
        path: The folder.
        on_progress: As for `write`.
        overwrite: Replace a folder that nanogs wrote.
        palette_size: As for `write`.
        bits: As for `write`.
        sh_bits: As for `write`.
        spare: As for `write`.

    Raises:
        OutputError: As for `write`, or the folder exists and may not be replaced, or it cannot be
            made.
    """
    options = SogOptions(palette_size, Precision(bits, spare), sh_bits)
    with atomic_folder(path, ours, overwrite=overwrite) as folder:
        for name, data in contents(splats, on_progress, options).items():
            (folder / name).write_bytes(data)


def contents(
    splats: Splats,
    on_progress: PartProgress = ignore_progress,
    options: SogOptions = USUAL_OPTIONS,
) -> dict[str, bytes]:
    """Encode a model; return the contents of `meta.json` and its textures by file name.

    Args:
        splats: N splats.
        on_progress: Progress callback for computing the palette.
        options: How values are quantised.

    Raises:
        OutputError: As for `write`.
    """
    with encoders() as pool:
        return start_encoding(pool, splats, None, on_progress, options)()


def encoders() -> ThreadPoolExecutor:
    """Make a thread pool for encoding textures, to be closed by the caller."""
    import numba

    return ThreadPoolExecutor(numba.get_num_threads())


def start_encoding(
    pool: ThreadPoolExecutor,
    splats: Splats,
    groups: I64 | None = None,
    on_progress: PartProgress = ignore_progress,
    options: SogOptions = USUAL_OPTIONS,
) -> Callable[[], dict[str, bytes]]:
    """Compute the textures and submit their WebP encoding to a thread pool.

    Args:
        pool: From `encoders`.
        splats: N splats.
        groups: (N,) group numbers from 0 on. Splats are sorted by group, and in Morton order within
            a group; by default all are one group.
        on_progress: As for `contents`.
        options: As for `contents`.

    Returns:
        A function that waits for the encoding and returns the same as `contents`.

    Raises:
        OutputError: As for `write`.
    """
    refuse_unstorable(splats)
    encoding: dict[str, Callable[[], bytes]] = {}

    def submit(name: str, texels: U8) -> None:
        future = parallel.try_submit(pool, texture.encode, texels)
        encoding[name] = future.result if future else partial(texture.encode, texels)

    meta = encode_model(splats, groups, options, submit, on_progress)
    text = json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()
    return lambda: {name: made() for name, made in encoding.items()} | {META: text}


def ours(folder: Path) -> frozenset[str] | None:
    """Return the names of the files in a folder that nanogs wrote, or None for other folders."""
    data = read_own(folder / META, "asset", "generator")
    if data is None:
        return None
    lists = [own.get("files") for own in data.values() if isinstance(own, dict)]
    named = [str(name) for each in lists if isinstance(each, list) for name in each]
    # Plain names only: a manipulated meta.json must not name files outside its folder.
    return frozenset({META, *filter(is_plain, named)})
