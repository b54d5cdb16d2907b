"""Frame rate of gsplat, measured if PyTorch, gsplat and a CUDA device are available."""

import importlib
import importlib.util
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from nanogs.raster.camera import Camera
from nanogs.splats import RenderMode, Splats

_REPEATS = 5


def gsplat_fps(splats: Splats, cameras: Sequence[Camera]) -> float | None:
    """Measure the frames per second of gsplat, frames in sequence, kernels compiled beforehand.

    Args:
        splats: The model; splats that are not finite are left out.
        cameras: At least one.

    Returns:
        The rate, or None if gsplat or a CUDA device is missing, or gsplat fails.
    """
    if not all(importlib.util.find_spec(name) for name in ("torch", "gsplat")):
        return None
    torch: Any = importlib.import_module("torch")
    if not torch.cuda.is_available():
        return None
    try:
        return _measure(torch, importlib.import_module("gsplat"), splats, cameras)
    except (RuntimeError, ImportError, OSError):  # out of memory, or kernels that do not compile
        return None


def _measure(torch: Any, gsplat: Any, splats: Splats, cameras: Sequence[Camera]) -> float:  # noqa: ANN401
    model = _model(torch, splats)
    views = [_view(torch, camera) for camera in cameras]
    with torch.no_grad():
        gsplat.rasterization(**model, **views[0])
        torch.cuda.synchronize()
        start = time.perf_counter()
        for _ in range(_REPEATS):
            for view in views:
                gsplat.rasterization(**model, **view)
        torch.cuda.synchronize()
    return _REPEATS * len(views) / (time.perf_counter() - start)


def _model(torch: Any, splats: Splats) -> dict[str, Any]:  # noqa: ANN401
    usable = splats.take(splats.finite())
    columns = {
        "means": usable.means,
        "quats": usable.unit_quats(),
        "scales": usable.scales(),
        "opacities": usable.opacities(),
        "colors": usable.sh,
    }
    mode = "antialiased" if splats.render_mode is RenderMode.MIP else "classic"
    return {name: _cuda(torch, column) for name, column in columns.items()} | {
        "sh_degree": splats.sh_degree,
        "rasterize_mode": mode,
        "packed": False,
    }


def _view(torch: Any, camera: Camera) -> dict[str, Any]:  # noqa: ANN401
    intrinsics = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    return {
        "viewmats": _cuda(torch, camera.world_to_camera)[None],
        "Ks": _cuda(torch, intrinsics)[None],
        "width": camera.width,
        "height": camera.height,
        "near_plane": camera.near,
    }


def _cuda(torch: Any, values: Any) -> Any:  # noqa: ANN401
    return torch.from_numpy(np.ascontiguousarray(values, np.float32)).cuda()
