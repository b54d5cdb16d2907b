"""Parsing the `meta.json` of SOG, PlayCanvas' compressed splats, versions 1 and 2.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/ and, for
version 1 and details missing there, https://github.com/playcanvas/splat-transform (MIT). A splat is
one texel, row by row, in each of these lossless WebP files, named in `meta.json`:

    means.files      low and high bytes of 16-bit codes, interpolated between mins and maxs to a
                     signed logarithm t; the coordinate is sign(t)(exp|t| - 1)
    quats.files      RGB, the three smaller components, a byte over ±1/√2 each; A is 252 + the index
                     (wxyz) of the largest, which is positive; any other A is no rotation
    scales.files     RGB, log-scales
    sh0.files        RGB, base colour coefficients; A, opacity
    shN.files        the palette, then R + 256 G, an index into it; the palette's texture has 64
                     entries per row, one texel per coefficient, RGB its channels

Version 2 (`version: 2`, `count`) maps bytes to values by codebooks of 256 entries, and A of sh0 is
alpha from 0 to 255. Version 1 (no `version`; the count is `means.shape[0]`) has mins and maxs in
place of codebooks, for each channel except in shN, and A of sh0 is a logit. `model` names the
render mode. Early files have null in place of the first codebook entry.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F32, F64, I64
from nanogs.activations import BYTE_LOGITS
from nanogs.io.json_fields import integer, numbers, plain_name, refused, rows, table
from nanogs.io.sog.texture import MAX_SIDE
from nanogs.splats import RenderMode

MAX_META_BYTES = 1 << 22  # a usual meta.json has 10 to 20 KB
CODES = 256  # number of codes of a byte
LAST_CODE = (1 << 16) - 1  # largest code of a coordinate, which has 16 bits
MAX_DEGREE = 3  # of SH coefficients
PALETTE_COLUMNS = 64
PALETTE_MAX = 1 << 16
MODELS = {
    "default": RenderMode.DEFAULT,
    "antialiased": RenderMode.MIP,
    "2dgs": RenderMode.SURFEL,
}
MAX_COUNT = MAX_SIDE**2


def is_manifest(path: Path) -> bool:
    """Return whether a SOG model is a folder, whose manifest this is; all others are zips.

    A zip may have any name, since the format of a file can be given apart from its name.
    """
    return path.name.lower().endswith(".json")


@dataclass(frozen=True, slots=True, eq=False)
class Meta:
    """A checked `meta.json`, of either version.

    Attributes:
        count: Number of splats.
        files: File name of each texture: means_l, means_u, quats, scales, sh0, and shN_centroids
            and shN_labels if there are higher SH coefficients.
        bounds: Two of (3,) float64, the signed logarithms of the coordinates for the first and the
            last 16-bit code.
        scales: (256, 3) float32, the log-scale of each byte in each channel.
        sh0: (256, 3) float32, the base colour coefficient of each byte in each channel.
        logits: (256,) float32, the opacity logit of each byte.
        sh_rest: (256,) float32, the higher coefficient of each byte; empty without them.
        degree: SH degree, or None if only the width of the palette's texture shows it.
        palette: Number of entries of the palette, or None if only the texture's size shows it.
        render_mode: The rasteriser the model was trained for.
        tagged: Whether the file states the render mode.
        notes: Notes for the user on values that were not understood.
    """

    count: int
    files: Mapping[str, str]
    bounds: tuple[F64, F64]
    scales: F32
    sh0: F32
    logits: F32
    sh_rest: F32
    degree: int | None
    palette: int | None
    render_mode: RenderMode
    tagged: bool
    notes: tuple[str, ...]

    def coordinates(self) -> F32:
        """Compute the coordinate of each code on each axis, (65536, 3), in scene units."""
        return _coordinates(*self.bounds, np.arange(LAST_CODE + 1))


def _coordinates(low: F64, high: F64, codes: I64) -> F32:
    logarithm = low + (high - low) * (codes[:, None] / LAST_CODE)
    with np.errstate(over="ignore"):
        values = np.sign(logarithm) * (np.exp(np.abs(logarithm)) - 1)
        out: F32 = values.astype(np.float32)
    return out


def read_meta(data: Mapping[str, Any], where: str) -> Meta:
    """Check the parsed contents of a `meta.json`.

    Args:
        data: The JSON object.
        where: The file, for messages.

    Raises:
        FormatError: A field is missing or violates the format.
    """
    version = data.get("version", 1)
    if version not in (1, 2) or isinstance(version, bool):
        raise refused(where, f"has version {str(version)[:20]!r}; nanogs reads 1 and 2")
    fields = _Fields(data, where, int(version))
    degree = fields.degree()
    rest = degree != 0
    mode, notes = _render_mode(data.get("model", "default"))
    return Meta(
        count=fields.count(),
        files=fields.files(rest),
        bounds=fields.bounds(),
        scales=fields.values("scales"),
        sh0=fields.values("sh0"),
        logits=fields.logits(),
        sh_rest=fields.sh_rest() if rest else np.empty(0, np.float32),
        degree=degree,
        palette=fields.palette() if rest else None,
        render_mode=mode,
        tagged=data.get("model") in MODELS,
        notes=notes,
    )


def _render_mode(model: object) -> tuple[RenderMode, tuple[str, ...]]:
    if isinstance(model, str) and model in MODELS:
        return MODELS[model], ()
    note = f"The render mode {str(model)[:40]!r} is unknown; the model was read as an ordinary one."
    return RenderMode.DEFAULT, (note,)


class _Fields:
    """Access to fields whose form differs between the versions."""

    def __init__(self, data: Mapping[str, Any], where: str, version: int) -> None:
        self._data, self._where, self._version = data, where, version

    def _table(self, name: str) -> dict[str, Any]:
        return table(self._data.get(name), self._at(name))

    def _at(self, name: str, field: str = "") -> str:
        return f"{self._where}, {name}{field and '.'}{field}"

    def count(self) -> int:
        if self._version == 2:
            return integer(self._data.get("count"), f"{self._where}, count", 1, MAX_COUNT)
        at = self._at("means", "shape")
        shape = rows(self._table("means").get("shape"), at)
        return integer(shape[0] if shape else None, f"{at}[0]", 1, MAX_COUNT)

    def degree(self) -> int | None:
        """Return the SH degree; None if only the width of the palette's texture shows it."""
        if self._data.get("shN") is None:
            return 0
        given = self._table("shN").get("bands")
        return None if given is None else integer(given, self._at("shN", "bands"), 0, MAX_DEGREE)

    def files(self, rest: bool) -> dict[str, str]:
        textures: dict[str, tuple[str, ...]] = {"means": ("means_l", "means_u")}
        textures |= {name: (name,) for name in ("quats", "scales", "sh0")}
        if rest:
            textures["shN"] = ("shN_centroids", "shN_labels")
        out: dict[str, str] = {}
        for name, own in textures.items():
            at = self._at(name, "files")
            given = rows(self._table(name).get("files"), at, len(own))
            out |= {texture: plain_name(file, at) for texture, file in zip(own, given, strict=True)}
        return out

    def bounds(self) -> tuple[F64, F64]:
        low, high = self._bounds("means", 3)
        if not np.isfinite(_coordinates(low, high, np.array([0, LAST_CODE]))).all():
            raise refused(self._at("means"), "has bounds beyond single precision")
        return low, high

    def _bounds(self, name: str, length: int) -> tuple[F64, F64]:
        own = self._table(name)
        low = numbers(own.get("mins"), self._at(name, "mins"), length)
        return low, numbers(own.get("maxs"), self._at(name, "maxs"), length)

    def values(self, name: str) -> F32:
        """Return the value of each byte in each channel, (256, 3)."""
        if self._version == 2:
            return np.repeat(self._codebook(name)[:, None], 3, axis=1)
        return self._between(name, 4 if name == "sh0" else 3)[:, :3]

    def logits(self) -> F32:
        if self._version == 1:
            return self._between("sh0", 4)[:, 3]
        return BYTE_LOGITS

    def sh_rest(self) -> F32:
        if self._version == 2:
            return self._codebook("shN")
        own = self._table("shN")
        ends = numbers([own.get("mins"), own.get("maxs")], self._at("shN", "mins and maxs"), 2)
        values = ends[0] + (ends[1] - ends[0]) * (np.arange(CODES) / 255)
        out: F32 = values.astype(np.float32)
        return out

    def _codebook(self, name: str) -> F32:
        at = self._at(name, "codebook")
        book = rows(self._table(name).get("codebook"), at, CODES)
        if book[0] is None:  # extrapolated in the same way as by PlayCanvas' engine
            known = numbers(book[1:], at, CODES - 1)
            book = [known[0] + (known[0] - known[-1]) / 255, *known]
            return np.array(book, np.float32)
        return numbers(book, at, CODES).astype(np.float32)

    def _between(self, name: str, channels: int) -> F32:
        low, high = self._bounds(name, channels)
        fraction = np.arange(CODES)[:, None] / 255
        out: F32 = (low + (high - low) * fraction).astype(np.float32)
        return out

    def palette(self) -> int | None:
        given = self._table("shN").get("count") if self._version == 2 else None
        return None if given is None else integer(given, self._at("shN", "count"), 1, PALETTE_MAX)
