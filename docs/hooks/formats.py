"""What each format keeps and loses, asked of the registry and measured on the generated scene."""

import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

import nanogs
from nanogs._types import F64, I64
from nanogs.activations import SH_C0, quaternions, rotations
from nanogs.datasets.synthetic import make_scene
from nanogs.io import bytes_on_disk
from nanogs.io.registry import Format, formats
from nanogs.splats import MAX_SH_DEGREE, ExtraElement, RenderMode, Splats

PROBE = 5000  # splats
SHARE = 99  # per cent of the values whose error a table states


@dataclass(frozen=True, slots=True)
class Kept:
    """What a format that is written holds of a model, beside numbers of less precision.

    Attributes:
        sh_degree: The highest degree.
        columns: Extra columns.
        elements: Further PLY elements.
        comments: Comment lines.
        mip: The tag of models trained with antialiasing.
        surfel: The tag of flat splats.
    """

    sh_degree: int
    columns: bool
    elements: bool
    comments: bool
    mip: bool
    surfel: bool


def variants(plain: Splats) -> dict[str, Splats]:
    """The model with one thing more, by the name of that thing in `Kept`."""
    labels = np.arange(len(plain), dtype=np.int32)
    element = ExtraElement("camera", np.zeros(2, [("focal", "f4")]))
    return {
        "columns": replace(plain, extras={"label": labels}),
        "elements": replace(plain, elements=[element]),
        "comments": replace(plain, comments=["made by hand"]),
        "mip": replace(plain, render_mode=RenderMode.MIP),
        "surfel": replace(plain, render_mode=RenderMode.SURFEL),
    }


def kept(known: Format, plain: Splats) -> Kept:
    """Ask a format what it loses of a model when it has one thing more."""
    base = set(known.losses(plain.with_sh_degree(0)))
    holds = {
        name: set(known.losses(model.with_sh_degree(0))) <= base
        for name, model in variants(plain).items()
    }
    degrees = [
        degree
        for degree in range(MAX_SH_DEGREE + 1)
        if set(known.losses(_tamed(plain, degree))) <= base
    ]
    return Kept(sh_degree=max(degrees), **holds)


def kept_table() -> str:
    """A row for every format that is written."""
    heads = ["format", "SH degree", "extra columns", "further elements", "comments",
             "mip tag", "2DGS tag"]  # fmt: skip
    plain = make_scene(100, sh_degree=MAX_SH_DEGREE)
    rows = []
    for known in _written():
        held = kept(known, plain)
        flags = (held.columns, held.elements, held.comments, held.mip, held.surfel)
        cells = [f"`{known.suffix}`", f"up to {held.sh_degree}" if held.sh_degree else "0"]
        rows.append([*cells, *("kept" if flag else "lost" for flag in flags)])
    return _markdown(heads, rows)


@dataclass(frozen=True, slots=True)
class Precision:
    """How a model comes back from a file.

    Attributes:
        bytes_per_splat: Of the file, at degree 3.
        ordered: Whether the rows stay in order.
        errors: Of centres (share of the scene's size), scales (share of themselves), rotations
            (degrees), alphas and base colours (0 to 1), and higher coefficients.
    """

    bytes_per_splat: float
    ordered: bool
    errors: tuple[float, ...]


def precision_table() -> str:
    """A row for every format that is written and read."""
    heads = ["format", "bytes a splat", "order", "centre", "scale", "rotation, degrees", "alpha",
             "base colour", "higher SH"]  # fmt: skip
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for known in _written():
            if not known.readable:
                continue
            found = _measure(known, Path(folder))
            cells = [f"`{known.suffix}`", f"{found.bytes_per_splat:.0f}"]
            cells.append("kept" if found.ordered else "changed")
            rows.append([*cells, *map(_error_text, found.errors)])
    return _markdown(heads, rows)


def frame_table() -> str:
    """Which way is up, format by format."""
    rows = [[f"`{known.suffix}`", known.frame] for known in formats()]
    return _markdown(["format", "frame"], rows)


def _written() -> list[Format]:
    return [known for known in formats() if known.writable]


def _tamed(plain: Splats, degree: int) -> Splats:
    """Of a degree, with no coefficient outside the range of a format."""
    model = plain.with_sh_degree(degree)
    return replace(model, sh=np.clip(model.sh, -0.5, 0.5))


@cache
def _probe() -> Splats:
    """Rows of less alpha than a byte can tell from none are left out: they may be dropped."""
    scene = make_scene(PROBE)
    return scene.take(scene.opacities() > 1 / 255)


def _measure(known: Format, folder: Path) -> Precision:
    own = folder / known.suffix.replace(".", "_")
    own.mkdir()
    path = own / (known.suffix if known.write_folder else f"probe{known.suffix}")
    if known.write_folder:
        path = own / "model" / known.suffix
    nanogs.save(_probe(), path)
    before, after = _probe(), nanogs.load(path)
    rows = _partners(before, after)
    return Precision(
        bytes_per_splat=bytes_on_disk(path) / len(before),
        ordered=bool((rows == np.arange(len(rows))).all()),
        errors=_errors(before.take(rows), after),
    )


def _partners(before: Splats, after: Splats) -> I64:
    """(N,) the row of the model that each row of the file was."""
    if np.abs(before.means - after.means).max() < 1e-2 * np.ptp(before.means):
        return np.arange(len(before))
    _, rows = cKDTree(before.means).query(after.means)
    return np.asarray(rows)


def _same_axes(before: Splats, after: Splats) -> Splats:
    """The model with the axes of each splat in the order and with the signs that the file has.

    An ellipsoid can be written in 24 ways, of which some formats have another one than the model.
    """
    matrices = rotations(before.unit_quats().astype(np.float64))
    along = matrices.transpose(0, 2, 1) @ rotations(after.unit_quats().astype(np.float64))
    axes = np.abs(along).argmax(axis=1)  # of the model, for each of the file's
    signs = np.sign(np.take_along_axis(along, axes[:, None], axis=1))
    turned = np.take_along_axis(matrices, axes[:, None], axis=2) * signs
    scales = np.take_along_axis(before.log_scales, axes, axis=1)
    return replace(before, quats=quaternions(turned).astype(np.float32), log_scales=scales)


def _errors(before: Splats, after: Splats) -> tuple[float, ...]:
    before = _same_axes(before, after)
    size = float(np.linalg.norm(np.ptp(before.means, axis=0)))
    one, other = before.unit_quats().astype(np.float64), after.unit_quats().astype(np.float64)
    chord = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    degree = min(before.sh_degree, after.sh_degree)
    parts: list[F64] = [
        np.abs(before.means.astype(np.float64) - after.means).max(axis=1) / size,
        np.abs(np.expm1(np.float64(after.log_scales) - before.log_scales)).max(axis=1),
        np.degrees(4 * np.arcsin(np.minimum(chord / 2, 1))),
        np.abs(before.opacities() - after.opacities()),
        SH_C0 * np.abs(np.float64(before.sh[:, 0]) - after.sh[:, 0]).max(axis=1),
    ]
    found = [float(np.percentile(part, SHARE)) for part in parts]
    if not degree:
        return (*found, np.inf)
    rest = np.abs(np.float64(before.with_sh_degree(degree).sh) - after.sh)[:, 1:]
    return (*found, float(np.percentile(rest.max(axis=(1, 2)), SHARE)))


def _error_text(error: float) -> str:
    if np.isinf(error):
        return "lost"
    return "exact" if error == 0 else f"{error:.1g}"


def _markdown(heads: list[str], rows: list[list[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
