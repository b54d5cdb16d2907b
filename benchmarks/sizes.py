"""Make splat-transform's largest file within each of several sizes, for scenes and formats.

    python benchmarks/sizes.py FOLDER [--scenes guitar,biker,skull] [--sizes 0.5MB,1MB]
        [--formats sog,spz]

Both of its modes decimate the scene's .ply to a count of splats, and a second process writes that
in the format, because splat-transform decimates to .ply only. The count is found by bisection on
the bytes, until the file takes 99 % of the size, or a count half a percent larger is too large,
because the size of its palettes is not continuous in the count. FOLDER gets
`SCENE_SIZE_MODE.FORMAT`, and beside each a .json with the seconds of the two processes that made
it, its splats and the number of counts tried. No file is made for a size that the whole scene fits
into. Existing files are not made again. The last line that is printed is the command that passes
the files to `nanogs bench --sizes-of-files`. Scenes and splat-transform are found as by
`quality.py`.
"""

import argparse
import json
import shlex
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from measurements import SCENES, UP, Bench
from nanogs.bench.rows import size_name
from nanogs.io import inspect
from nanogs.quantities import parse_bytes
from rivals import BUILD, REAL_SCENES, RIVALS, install, run_tool

SIZES = "0.25MB,0.5MB,1MB,2MB,4MB"
ENOUGH = 0.99  # share of the size from which a file ends the search
CLOSE = 0.005  # relative difference of a count that fits and one that does not, to end the search
FIRST = 14  # bytes per splat, the initial guess


@dataclass(frozen=True)
class Found:
    """The largest count that fits, the number of counts tried, and the seconds to make its file."""

    count: int
    tried: int
    seconds: float


def main() -> None:
    """Make the missing files, and print the command that measures all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--sizes", default=SIZES)
    parser.add_argument("--formats", default="sog,spz")
    parser.add_argument("--modes", default=",".join(RIVALS))
    options = parser.parse_args()
    install()
    options.folder.mkdir(parents=True, exist_ok=True)
    bench = Bench(REAL_SCENES, REAL_SCENES.parent / "peers", BUILD)
    for scene in options.scenes.split(","):
        model = bench.model(scene)
        for suffix in options.formats.split(","):
            each = float(FIRST)
            for size in sorted(map(parse_bytes, options.sizes.split(","))):
                for mode in options.modes.split(","):
                    name = f"{scene}_{size_name(size)}_{mode}.{suffix}"
                    each = make(model, mode, size, options.folder / name, each)
    print(command(bench, options))


def make(model: Path, mode: str, size: int, target: Path, each: float) -> float:
    """Make the largest file of a mode within a size, unless it exists.

    Args:
        model: The scene.
        mode: Key of `RIVALS`.
        size: Maximum bytes of the file.
        target: The file.
        each: Bytes per splat, an initial guess.

    Returns:
        Bytes per splat of the file, the guess for the next one.
    """
    note = target.with_name(f"{target.name}.json")
    if note.exists():
        return float(target.stat().st_size / json.loads(note.read_text())["count"])
    with tempfile.TemporaryDirectory() as folder:
        decimated, written = Path(folder) / "small.ply", Path(folder) / target.name

        def write(count: int) -> tuple[int, float]:
            seconds, _ = run_tool(model, RIVALS[mode], str(count), decimated)
            more, _ = run_tool(decimated, written)
            took = written.stat().st_size
            if took <= size:
                written.replace(target)
            return took, seconds + more

        found = largest(write, size, inspect(model).splats, each)
    if found is None:
        target.unlink()
        print(f"{target.name}: the whole scene fits", file=sys.stderr, flush=True)
        return each
    note.write_text(json.dumps(asdict(found)) + "\n")
    took = f"{target.stat().st_size:,} B, {found.count:,} splats, {found.tried} tried"
    print(f"{target.name}: {took}, {found.seconds:.1f} s", file=sys.stderr, flush=True)
    return target.stat().st_size / found.count


def largest(
    write: Callable[[int], tuple[int, float]], size: int, available: int, each: float
) -> Found | None:
    """Search the largest count whose file fits; None if the whole scene fits.

    Args:
        write: Writes the file of a count, and returns its bytes and seconds. Of the counts that
            fit, each is larger than those before.
        size: Maximum bytes.
        available: Splats of the scene.
        each: Bytes per splat, an initial guess.
    """
    fits, too_large, tries = Found(0, 0, 0.0), available + 1, 0
    fits_bytes, over_bytes = 0, 0
    count = min(int(0.995 * size / each), available)
    while too_large - fits.count > max(1, CLOSE * fits.count):
        took, seconds = write(count)
        tries += 1
        if took <= size:
            fits, fits_bytes = Found(count, tries, seconds), took
            if count == available:
                return None
            if took >= ENOUGH * size:
                break
        else:
            too_large, over_bytes = count, took
        count = _next(fits.count, fits_bytes, too_large, over_bytes, size, tries)
        count = min(count, available)
    if not fits.count:
        sys.exit(f"Not even one splat fits into {size:,} B.")
    return replace(fits, tried=tries)


def _next(fits: int, fits_bytes: int, over: int, over_bytes: int, size: int, tried: int) -> int:
    """Interpolate the count whose file is just below the size; bisect every third time.

    Bisection is needed because the bytes are not continuous in the count.
    """
    if not over_bytes:
        return int(fits * min(0.996 * size / fits_bytes, 4)) + 1
    share = 0.5 if tried % 3 == 0 else (0.996 * size - fits_bytes) / (over_bytes - fits_bytes)
    return min(max(fits + int(share * (over - fits)), fits + 1), over - 1)


def command(bench: Bench, options: argparse.Namespace) -> str:
    """Return the command that measures the files together with ours.

    Scenes that need an up direction must be run separately, and are listed in a comment.

    Args:
        bench: The scenes.
        options: The command line.
    """
    scenes = options.scenes.split(",")
    words = ["nanogs", "bench", *(f"--scene={name}={bench.model(name)}" for name in scenes)]
    words += ["--sizes-of-files", options.sizes, "--format", options.formats]
    files = options.folder / "{scene}_{size}_MODE.{format}"
    words += [
        f"--external={mode}={str(files).replace('MODE', mode)}" for mode in options.modes.split(",")
    ]
    apart = [f"{name} with --up {','.join(map(str, UP[name]))}" for name in scenes if name in UP]
    return shlex.join(words) + (f"  # {'; '.join(apart)}" if apart else "")


if __name__ == "__main__":
    main()
