"""Computing the textures and the `meta.json` of a model; their layout is described in `meta`.

As in PlayCanvas' own tool, splats are in Morton order, so that neighbouring texels are similar.
"""

from typing import Any

import numpy as np

from nanogs._types import I64
from nanogs.io.generator import GENERATOR
from nanogs.io.rotations import minimise_rotation
from nanogs.io.sog.centres import centre_codes, morton_order
from nanogs.io.sog.codebook import json_values, nearest
from nanogs.io.sog.codes import alpha_codes, codebooks, quat_texels, rotation_rounding
from nanogs.io.sog.harmonics import encode_harmonics
from nanogs.io.sog.meta import MODELS
from nanogs.io.sog.options import SogOptions
from nanogs.io.sog.texture import Submit, as_texture
from nanogs.progress import PartProgress
from nanogs.splats import RenderMode, Splats

_MODELS = {mode: name for name, mode in MODELS.items()}


def encode_model(
    splats: Splats,
    groups: I64 | None,
    options: SogOptions,
    submit: Submit,
    on_progress: PartProgress,
) -> dict[str, Any]:
    """Compute and submit every texture, and return the contents of `meta.json`.

    Args:
        splats: N splats that the format can hold.
        groups: (N,) group numbers; see `write.start_encoding`.
        options: How values are quantised.
        submit: Called with each texture.
        on_progress: Progress callback for computing the palette.
    """
    precision = options.precision
    scales, colours = codebooks(splats, precision)
    codes, bounds = centre_codes(splats, scales, precision)
    rows = morton_order(codes, groups)
    codes = codes[rows]
    submit("means_l.webp", as_texture((codes & 255).astype(np.uint8)))
    submit("means_u.webp", as_texture((codes >> 8).astype(np.uint8)))
    splats = splats.take(rows)
    flat = splats.render_mode is RenderMode.SURFEL
    rounding = rotation_rounding(precision.rotation_step)
    quats, log_scales = minimise_rotation(splats, rounding, third_stays=flat)
    submit("quats.webp", as_texture(quat_texels(quats, precision.rotation_step, without_w=flat)))
    submit("scales.webp", as_texture(nearest(log_scales, scales)))
    alphas = alpha_codes(splats.opacities(), precision.alpha_steps)
    submit("sh0.webp", as_texture(np.column_stack([nearest(splats.sh[:, 0], colours), alphas])))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": GENERATOR},
        "count": len(rows),
        "model": _MODELS[splats.render_mode],
        "means": bounds | {"files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": json_values(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": json_values(colours), "files": ["sh0.webp"]},
    }
    if splats.render_mode is RenderMode.DEFAULT:
        del meta["model"]  # older writers do not tag the default either
    if splats.sh_degree:
        meta["shN"] = encode_harmonics(splats, options, submit, on_progress)
    return meta
