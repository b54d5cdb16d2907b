"""`nanogs.render`: render a model into arrays."""

from collections.abc import Iterable, Sequence

from nanogs._types import F32
from nanogs.bar import show_progress
from nanogs.io.models import Model, opened
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import BLACK, PIXELS, VIEWS, plain_background
from nanogs.quantities import as_bytes
from nanogs.ranges import as_switch
from nanogs.source import source_of
from nanogs.views.cameras import Cameras, chosen_cameras, known_cameras
from nanogs.views.costing import pictures_of
from nanogs.views.plan import budget_for_pictures, rendering_remedy


def render(
    model: Model,
    cameras: Cameras = "auto",
    *,
    views: int = VIEWS,
    pixels: int | tuple[int, int] = PIXELS,
    up: Sequence[float] | None = None,
    background: Iterable[float] = BLACK,
    transparent: bool = False,
    device: str | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
) -> list[F32]:
    """Render an image of a model for each view; the same bytes for any number of threads.

    Args:
        model: The model, or a path.
        cameras: "auto" for views that are chosen from the model, "orbit" for views around it,
            "inside" for views in a room, "roam" for views from anywhere, near and far; or a camera
            file or data-set folder; or cameras.
        views: Number of automatic views.
        pixels: Size of an automatic view: one number for both width and height, or both.
        up: (3,) up direction of automatic views in scene coordinates; found from the model by
            default.
        background: RGB in [0, 1].
        transparent: Return straight (not premultiplied) alpha too, and no background.
        device: Device that renders: "cpu", the default; "cuda" for a GPU; or "auto" for a GPU if
            there is one. Their images differ by rounding.
        threads: Number of threads; all by default.
        max_memory: Bytes of memory that this process may use, a number or text such as "4GB"; by
            default the free memory, less a tenth. A model that does not fit is streamed in blocks
            of rows, in as many passes as needed: the images are the same.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`; the views are parts of one stage.

    Returns:
        (H, W, 3) float32 for each view, RGB in [0, 1] as a screen shows it; with `transparent`
        (H, W, 4).

    Raises:
        FormatError: The model or the cameras cannot be read.
        ModelError: Nothing of the model is visible, so that no views are found.
        NotEnoughMemoryError: Even streaming takes more memory than is free or allowed.
        OptionError: An argument is out of range, or there is no such device.
    """
    wanted = known_cameras(cameras, up, views, pixels)
    transparent = as_switch("`transparent`", transparent)
    with opened(model) as source:
        most = None if max_memory is None else as_bytes(max_memory)
        budget = budget_for_pictures(
            source, *pictures_of(wanted, views, pixels), most, remedy=rendering_remedy(wanted)
        )
        some = source_of(source).load() if budget is None else source
        # Imported late, because these import Numba.
        from nanogs.card.device import use_device
        from nanogs.raster.images import straight
        from nanogs.threads import use_threads
        from nanogs.views.streamed import drawable, renderings

        # Straight alpha needs a render over black.
        behind = BLACK if transparent else plain_background(background)
        with use_device(device), use_threads(threads), show_progress(progress) as on_step:
            chosen, _ = chosen_cameras(some, wanted, views, pixels, up)
            tracker = Tracker(on_step, [Stage("render", 1.0)])
            shown = renderings(
                drawable(some, budget), chosen, background=behind, on_progress=tracker.part
            )
            images = [straight(each) if transparent else each.shown() for each in shown]
            tracker.finish()
    return images
