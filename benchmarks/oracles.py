"""Compare our readers and writers with those of other programs, on real scenes and SH degrees.

    python benchmarks/oracles.py [SCENES] [--only biker,skull] [--rows 2000] [--whole] [--out FILE]

splat-transform (npm, see rivals.py), gsply and gaussforge (`pip install gsply gaussforge
imagecodecs`) read our files and write files that we read. Each scene is used with --rows of its
splats at degrees 0 to 3, with random higher coefficients if the scene has none; with --whole also
unchanged. SCENES is by default ../shared/scenes beside the repository. tests/test_oracles.py does
the same with a small model.

The table gives the largest differences, in quantisation steps of the format (for float32 columns,
in millionths). *read* and *read theirs*: between the values that we and the other program read from
our file, and from theirs. *kept*: between the model and the values that we read back from our file
(row nanogs) or from theirs. Rounding to the nearest step differs by at most 0.5; the largest
component of a rotation is computed from the others and may differ by more. Values that a format
cannot hold are clamped first. Two things are not compared: the palette of SOG, which has no steps,
and higher coefficients of `.ksplat`, which gaussforge writes in an order that is not the format's.
"""

import argparse
import functools
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from measurements import SCENES
from nanogs import io
from nanogs.activations import SH_C0
from nanogs.io.rotations import minimise_rotation
from nanogs.splats import Splats
from rivals import REAL_SCENES, install, run_tool

FORMATS = (".ply", ".compressed.ply", ".splat", ".spz", ".spz v4", ".sog", ".glb", ".ksplat")
COLUMNS = ("centre", "scale", "rotation", "alpha", "colour", "harmonics")
CANDIDATES = 16  # rows of the file, with the nearest centres, among which a splat is looked for
FINE = 1e6  # steps per unit of float32 columns
Steps = dict[str, np.ndarray]


def main() -> None:
    """Run all comparisons and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=REAL_SCENES)
    parser.add_argument("--only", default=",".join(SCENES))
    parser.add_argument("--rows", type=int, default=2_000)
    parser.add_argument("--whole", action="store_true", help="take whole scenes too")
    parser.add_argument("--out", type=Path, help="write every figure as JSON")
    options = parser.parse_args()
    install()
    found: list[dict[str, Any]] = []
    for name in options.only.split(","):
        for label, model in models(name, io.load(options.scenes / SCENES[name]), options):
            with tempfile.TemporaryDirectory() as folder:
                found += [row | {"scene": label} for row in held(model, Path(folder))]
            print(label, len(model), file=sys.stderr, flush=True)
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n")
    print(table(found))


def models(name: str, scene: Splats, options: argparse.Namespace) -> Iterator[tuple[str, Splats]]:
    """Yield some splats of a scene at each degree up to 3; with --whole also the whole scene."""
    if options.whole:
        yield name, plain(scene)
    some = scene.take(np.arange(0, len(scene), -(-len(scene) // options.rows)))
    for degree in range(4):
        yield f"{name}, {degree}", plain(with_degree(some, degree))


def plain(model: Splats) -> Splats:
    """Reduce a model to what all formats can hold: finite splats in float32, nothing else."""
    model = model.take(np.flatnonzero(model.finite() & np.isfinite(model.log_scales).all(axis=1)))
    return replace(model, means=model.means.astype(np.float32), comments=(), notes=())


def with_degree(model: Splats, degree: int) -> Splats:
    """Change the model's SH degree; missing coefficients are random."""
    missing = (degree + 1) ** 2 - model.sh.shape[1]
    if missing <= 0:
        return model.with_sh_degree(degree)
    drawn = np.random.default_rng(degree).normal(0, 0.15, (len(model), missing, 3))
    return replace(model, sh=np.concatenate([model.sh, drawn.astype(np.float32)], axis=1))


# --- other programs


def transform(source: Path, target: Path, *options: str) -> Path:
    """Convert a file with splat-transform."""
    run_tool(source, target, *options)
    return target


def forge(source: Path, target: Path, version: int = 3) -> Path:
    """Convert a file with gaussforge."""
    from gaussforge import GaussForge

    kinds = [format_of(path).lstrip(".") for path in (source, target)]
    converted = GaussForge().convert(source.read_bytes(), *kinds, spz_version=version)
    if "error" in converted:
        raise ValueError(converted["error"])
    target.write_bytes(converted["data"])
    return target


def format_of(path: Path) -> str:
    """Return the suffix of a file, which has two parts for a compressed PLY."""
    return ".compressed.ply" if path.name.endswith(".compressed.ply") else path.suffix


def gsply_reads(path: Path) -> Splats:
    """Read a file with gsply."""
    import gsply

    names = {".spz": "read_spz", ".sog": "sogread"}  # its old versions have not both
    read = getattr(gsply, names.get(path.suffix, "plyread"))
    data = read(str(path))
    higher = [] if data.shN is None or not data.shN.size else [data.shN]
    sh = np.concatenate([data.sh0[:, None], *higher], axis=1)
    return Splats(data.means, data.scales, data.quats, data.opacities, sh)


def gsply_writes(source: Path, target: Path, version: int = 3) -> Path:
    """Convert a `.ply` file with gsply."""
    import gsply

    data = gsply.plyread(str(source))
    if target.suffix == ".spz":
        gsply.write_spz(str(target), data, version=version)
    else:
        gsply.plywrite(str(target), data, compressed=target.name.endswith(".compressed.ply"))
    return target


def by_ply(convert: Callable[[Path, Path], Path], path: Path) -> Splats:
    """Read a file with another program, which converts it to `.ply` for us."""
    return io.load(convert(path, path.with_name("read.ply")))


Program = tuple[str, set[str], Callable[[Path], Splats], dict[str, Callable[[Path, Path], Path]]]
PROGRAMS: tuple[Program, ...] = (
    (
        "splat-transform",
        set(FORMATS) - {".glb"},
        lambda path: by_ply(transform, path),
        dict.fromkeys((".ply", ".compressed.ply", ".sog", ".glb"), transform)
        | {
            ".spz": lambda a, b: transform(a, b, "--spz-version", "3"),
            ".spz v4": lambda a, b: transform(a, b, "--spz-version", "4"),
        },
    ),
    (
        "gsply",
        {".ply", ".compressed.ply", ".spz", ".spz v4", ".sog"},
        gsply_reads,
        dict.fromkeys((".ply", ".compressed.ply", ".spz"), gsply_writes)
        | {".spz v4": lambda a, b: gsply_writes(a, b, 4)},
    ),
    (
        "gaussforge",
        {".ply", ".compressed.ply", ".splat", ".spz", ".spz v4", ".sog", ".ksplat"},
        lambda path: by_ply(forge, path),
        dict.fromkeys((".compressed.ply", ".splat", ".spz", ".sog", ".ksplat"), forge)
        | {".spz v4": lambda a, b: forge(a, b, 4)},
    ),
)


# --- comparing


def held(
    model: Splats, folder: Path, programs: Sequence[Program] = PROGRAMS
) -> Iterator[dict[str, Any]]:
    """Yield the largest differences of one model, by format and program."""
    ply = folder / "model.ply"
    io.save(model, ply)
    for kind in FORMATS:
        suffix = kind.partition(" ")[0]
        expected = model.with_sh_degree(0) if kind == ".splat" else model
        ours = folder / f"ours{suffix}"
        if kind != ".ksplat":
            version = 4 if kind == ".spz v4" else None
            io.save(model, ours, overwrite=True, format_options={"spz_version": version})
            yield {"format": kind, "program": "nanogs"} | {"kept": kept(kind, expected, ours)}
        for name, reads, read, writes in programs:
            row: dict[str, Any] = {"format": kind, "program": name}
            try:
                if kind in reads and kind != ".ksplat":
                    row["read"] = alike(kind, ours, read)
                if kind in writes:
                    theirs = writes[kind](ply, folder / f"theirs{suffix}")
                    if kind in reads:
                        row["read theirs"] = alike(kind, theirs, read)
                    row["kept"] = kept(kind, expected, theirs)
            except Exception as error:  # other programs may raise anything
                row["failed"] = f"{type(error).__name__}: {error}"[:200]
            yield row


def alike(kind: str, path: Path, read: Callable[[Path], Splats]) -> dict[str, float]:
    """Compare the values that we and another program read from one file, row by row."""
    ours = io.load(path)
    rows = np.arange(len(ours))
    return largest(ours, read(path), rows, quantised(kind, ours))


def kept(kind: str, model: Splats, path: Path) -> dict[str, float]:
    """Compare a model with the values in a file, whose rows may be in another order.

    Several splats may have the same centre, so each is matched to the most similar of the nearest
    rows.
    """
    file = io.load(path)
    if len(file) != len(model):
        raise ValueError(f"{len(file)} splats of {len(model)}")
    measure = quantised(kind, file)
    model = clamped(kind, model)
    tree = cKDTree(file.means.astype(np.float64))
    near = tree.query(model.means, min(CANDIDATES, len(file)))[1].reshape(len(model), -1)
    best, rows = np.full(len(model), np.inf), near[:, 0].copy()
    for candidates in near.T:
        expected = with_axes_of(model, file.take(candidates))
        apart = differences(model, expected, measure, candidates)
        cost = np.max([column.max(axis=1) for column in apart.values()], axis=0)
        better = cost < best
        best[better], rows[better] = cost[better], candidates[better]
    return largest(model, with_axes_of(model, file.take(rows)), rows, measure)


def with_axes_of(model: Splats, other: Splats) -> Splats:
    """Rewrite the other model's axes: of the 24 equivalent ways, the nearest to this model's."""
    quats = model.unit_quats().astype(np.float64)
    between = product(quats * [1, -1, -1, -1], other.unit_quats().astype(np.float64))
    turned, scales = minimise_rotation(replace(other, quats=between.astype(np.float32)))
    return replace(other, quats=product(quats, turned).astype(np.float32), log_scales=scales)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiply quaternions, wxyz."""
    w, v, x, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    real = w * x - (v * u).sum(axis=1, keepdims=True)
    return np.hstack([real, w * u + x * v + np.cross(v, u)])


def largest(
    a: Splats, b: Splats, rows: np.ndarray, measure: Callable[[Splats, np.ndarray], Steps]
) -> dict[str, float]:
    """Return the largest difference of each column, in steps."""
    found = differences(a, b, measure, rows)
    return {name: float(column.max()) for name, column in found.items() if column.size}


def differences(
    a: Splats, b: Splats, measure: Callable[[Splats, np.ndarray], Steps], rows: np.ndarray
) -> Steps:
    """Compute the differences (N, C), in steps, of each column of two models of N splats."""
    first, second = measure(a, rows), measure(b, rows)
    sign = np.sign((first["rotation"] * second["rotation"]).sum(axis=1, keepdims=True))
    first["rotation"] = first["rotation"] * np.where(sign == 0, 1, sign)
    apart = {name: np.abs(first[name] - second[name]) for name in first if first[name].size}
    # Colours of invisible splats are not compared: WebP may drop them in splat-transform's SOG.
    apart["colour"][second["alpha"][:, 0] == 0] = 0
    return apart


def clamped(kind: str, model: Splats) -> Splats:
    """Clamp the model to the ranges of the format."""
    scales, sh = model.log_scales, model.sh.copy()
    if kind.startswith(".spz"):
        scales = scales.clip(-10, 5.9375)
        sh[:, 0] = sh[:, 0].clip(-0.5 / 0.15, 0.5 / 0.15)
        sh[:, 1:] = sh[:, 1:].clip(-1, 127 / 128)
    elif kind in (".splat", ".ksplat"):
        sh[:, 0] = sh[:, 0].clip(-0.5 / SH_C0, 0.5 / SH_C0)
    elif kind == ".compressed.ply":
        scales = scales.clip(-20, 20)
        sh[:, 1:] = sh[:, 1:].clip(-4, 4)
    return replace(model, log_scales=scales, sh=sh)


def quantised(kind: str, file: Splats) -> Callable[[Splats, np.ndarray], Steps]:
    """Return a function of a model and rows of the file that scales columns to quantisation steps.

    Args:
        kind: The format.
        file: The model read from the file, in its order.
    """
    measures = {".compressed.ply": _chunks, ".sog": _books}
    return functools.partial(measures.get(kind, _even), kind, file)


# Steps per unit of centres, log-scales, quaternion components, alphas, base colours, higher SH.
_SPZ = (2**12, 16, 511 / 0.5**0.5, 255, 255 * 0.15, 16)
_EVEN = {
    ".spz": _SPZ,
    ".spz v4": _SPZ,
    ".splat": (FINE, FINE, 128, 255, 255 * SH_C0, 0),
    ".ksplat": (FINE, FINE, FINE, 255, 255 * SH_C0, 0),
}


def _even(kind: str, file: Splats, model: Splats, _rows: np.ndarray) -> Steps:
    steps = _EVEN.get(kind, (FINE,) * len(COLUMNS))
    higher = model.sh[:, 1:].reshape(len(model), -1).astype(np.float64)
    if kind.startswith(".spz"):  # 5 bits, and 4 for the bands above the first
        higher = np.concatenate([higher[:, :9], higher[:, 9:] / 2], axis=1)
    size = float(np.abs(file.means).max()) if steps[0] == FINE else 1.0
    return _columns(model, model.means / size, model.log_scales, model.sh[:, 0], higher, steps)


def _columns(
    model: Splats,
    centres: np.ndarray,
    scales: np.ndarray,
    colours: np.ndarray,
    higher: np.ndarray,
    steps: tuple[float, ...],
) -> Steps:
    quats = model.unit_quats().astype(np.float64)
    alphas = model.opacities().astype(np.float64)[:, None]
    values = (centres, scales, quats, alphas, colours, higher)
    return {
        name: np.asarray(value, np.float64) * step
        for name, value, step in zip(COLUMNS, values, steps, strict=True)
    }


def _chunks(_kind: str, file: Splats, model: Splats, rows: np.ndarray) -> Steps:
    """Scale columns of a compressed PLY, whose steps depend on the extents of each row's chunk."""

    def in_chunks(values: np.ndarray, own: np.ndarray, levels: tuple[int, ...]) -> np.ndarray:
        starts = np.arange(0, len(own), 256)
        extent = np.maximum.reduceat(own, starts) - np.minimum.reduceat(own, starts)
        extent = np.maximum(extent.astype(np.float64), 1e-6 * np.abs(own).max() + 1e-30)
        scaled: np.ndarray = values.astype(np.float64) / (extent / levels)[rows // 256]
        return scaled

    wide = (2047, 1023, 2047)
    higher = model.sh[:, 1:].reshape(len(model), -1)
    centres = in_chunks(model.means, file.means, wide)
    scales = in_chunks(model.log_scales, file.log_scales, wide)
    colours = in_chunks(model.sh[:, 0], file.sh[:, 0], (255,) * 3)
    return _columns(model, centres, scales, colours, higher, (1, 1, 1023 / 2**0.5, 255, 1, 32))


def _books(_kind: str, file: Splats, model: Splats, _rows: np.ndarray) -> Steps:
    """Scale columns of a SOG: centres in logarithmic steps, codebook columns in entry indices."""
    signed = [np.copysign(np.log1p(np.abs(m.means.astype(float))), m.means) for m in (file, model)]
    extent = np.maximum(signed[0].max(axis=0) - signed[0].min(axis=0), 1e-12)
    books = [np.unique(values) for values in (file.log_scales, file.sh[:, 0])]
    scales, colours = (
        np.interp(values, book, np.arange(len(book)))
        for values, book in zip((model.log_scales, model.sh[:, 0]), books, strict=True)
    )
    higher = np.empty((len(model), 0))  # of a palette
    steps = (1, 1, 255 / 2**0.5, 255, 1, 1)
    return _columns(model, signed[1] * 65535 / extent, scales, colours, higher, steps)


def table(found: list[dict[str, Any]]) -> str:
    """Return the largest differences over all scenes, as Markdown."""
    lines = ["| format | program | | " + " | ".join(COLUMNS) + " |", "|---" * 9 + "|"]
    for kind in FORMATS:
        for name in ("nanogs", *(program[0] for program in PROGRAMS)):
            rows = [row for row in found if (row["format"], row["program"]) == (kind, name)]
            for label in ("read", "read theirs", "kept"):
                measured = [row[label] for row in rows if label in row]
                if not measured:
                    continue
                worst = [max((m.get(c, -1) for m in measured), default=-1) for c in COLUMNS]
                cells = ["" if value < 0 else f"{value:.2f}" for value in worst]
                lines.append(f"| `{kind}` | {name} | {label} | {' | '.join(cells)} |")
            failed = [row["failed"] for row in rows if "failed" in row]
            if failed:
                label = f"failed {len(failed)} of {len(rows)}: {min(failed)}"
                lines.append(f"| `{kind}` | {name} | {label} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
