"""`nanogs.render`: pictures of a model, as arrays."""

from collections.abc import Sequence

from nanogs._types import F32
from nanogs.bar import drawn
from nanogs.io.models import Model, as_splats
from nanogs.progress import Progress, Stage, Tracker, each
from nanogs.protocol import BLACK, PIXELS, VIEWS, Background
from nanogs.views.cameras import Cameras, chosen_cameras


def render(
    model: Model,
    cameras: Cameras = "auto",
    *,
    views: int = VIEWS,
    pixels: int | tuple[int, int] = PIXELS,
    up: Sequence[float] | None = None,
    background: Background = BLACK,
    transparent: bool = False,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> list[F32]:
    """Pictures of a model, one for each view; the same bytes for any number of threads.

    Args:
        model: The model, or a path.
        cameras: "auto" for views that are found from the model, "orbit" for views around it,
            "inside" for views in a room, "roam" for views from anywhere, near and far; or a camera
            file or data-set folder; or cameras.
        views: Number of automatic views.
        pixels: Of an automatic view: width and height in one number, or both.
        up: (3,) direction of automatic views, scene units; found from the model by default.
        background: RGB in [0, 1].
        transparent: Give straight alpha too, and no background.
        threads: Threads to use; all by default.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`; the views are
            parts of one stage.

    Returns:
        (H, W, 3) float32 for each view, RGB in [0, 1] as a screen shows it; with `transparent`
        (H, W, 4).

    Raises:
        FormatError: The model or the cameras cannot be read.
        ModelError: Nothing of the model is visible, so that no views are found.
        OptionError: An argument is out of range.
    """
    splats = as_splats(model)
    chosen, _ = chosen_cameras(splats, cameras, views, pixels, up)
    # Here and not above: these bring Numba.
    from nanogs.raster.images import straight
    from nanogs.raster.rendering import prepare
    from nanogs.raster.rendering import render as render_one
    from nanogs.threads import use_threads

    behind = BLACK if transparent else background  # straight alpha is taken from one over black
    images = []
    with use_threads(threads), drawn(progress) as tell:
        tracker = Tracker(tell, [Stage("render", 1.0)])
        prepared = prepare(splats)
        for camera in each(chosen, tracker.part):
            rendering = render_one(prepared, camera, background=behind)
            images.append(straight(rendering) if transparent else rendering.shown())
        tracker.finish()
    return images
