"""Summary of a model: one line for `repr`, and with a small picture above it for notebooks."""

import base64
import html as markup
import zlib
from weakref import WeakKeyDictionary

import numpy as np

from nanogs.formatting import counted
from nanogs.raster.camera import Camera
from nanogs.splats import Splats

WIDTH, HEIGHT = 480, 320  # size of the picture, pixels

# Notebooks ask for a picture twice. Each is kept with a checksum of the arrays, which may change.
_pictures: "WeakKeyDictionary[Splats, tuple[int, bytes]]" = WeakKeyDictionary()


def one_line(splats: Splats) -> str:
    """Return the number of splats, SH degree, render mode, bounds and extra columns in one line."""
    parts = [
        counted(len(splats), "splat"),
        f"SH degree {splats.sh_degree}",
        f"render mode {splats.render_mode}",
        _bounds_text(splats),
    ]
    if splats.extras:
        parts.append(f"extra columns {', '.join(splats.extras)}")
    return "; ".join(parts)


def html(splats: Splats) -> str:
    """Return the picture with the line beneath it, or the line and why there is no picture."""
    line = f"<div>{markup.escape(repr(splats))}</div>"
    found = picture(splats)
    if isinstance(found, str):
        return f"{line}<div>No picture: {markup.escape(found)}</div>"
    data = base64.b64encode(found).decode()
    return f'<img src="data:image/png;base64,{data}" width="{WIDTH}" height="{HEIGHT}">{line}'


def picture(splats: Splats) -> bytes | str:
    """Return a PNG of the whole model, or the reason why there is none. Never raises."""
    try:
        found, now = _pictures.get(splats), _checksum(splats)
        if found is None or found[0] != now:
            found = _pictures[splats] = now, _render(splats)
    except Exception as error:  # a missing picture must not fail the notebook's cell
        return str(error) or type(error).__name__
    return found[1]


def _checksum(splats: Splats) -> int:
    """Return a checksum of the arrays that a picture depends on."""
    columns = splats.means, splats.log_scales, splats.quats, splats.opacity_logits, splats.sh
    return hash(tuple(zlib.crc32(np.ascontiguousarray(column).data) for column in columns))


def _render(splats: Splats) -> bytes:
    from io import BytesIO

    from PIL import Image

    from nanogs.raster.images import to_bytes
    from nanogs.raster.rendering import render

    file = BytesIO()
    Image.fromarray(to_bytes(render(splats, _overview(splats)).color)).save(file, format="PNG")
    return file.getvalue()


def _overview(splats: Splats) -> Camera:
    """Return the camera that `nanogs view` starts from too."""
    from nanogs.views.opening import opening_for
    from nanogs.views.poses import look_at

    start = opening_for(splats)
    focal = min(WIDTH, HEIGHT) / 2 / start.tangent
    pose = look_at(start.position, start.target, start.up)
    near = start.near * start.distance
    return Camera(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, pose, "overview", near)


def _bounds_text(splats: Splats) -> str:
    means = splats.means[np.isfinite(splats.means).all(axis=1)]
    if not len(means):
        return "no bounds"
    low, high = (" ".join(f"{v:.4g}" for v in corner) for corner in (means.min(0), means.max(0)))
    return f"bounds {low} to {high}"
