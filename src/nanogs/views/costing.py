"""`nanogs.draw_cost`: measure the cost of drawing a model."""

from collections.abc import Sequence

from nanogs.bar import show_progress
from nanogs.costs import DrawCost
from nanogs.io.models import Model, opened
from nanogs.progress import Progress, Stage, Tracker
from nanogs.protocol import BLACK, PIXELS, VIEWS, Background, Kind, Protocol
from nanogs.quantities import as_bytes
from nanogs.raster.camera import Camera
from nanogs.source import source_of
from nanogs.views.cameras import Cameras, chosen_cameras, known_cameras, picture_size, view_count
from nanogs.views.plan import budget_for_pictures, rendering_remedy


def draw_cost(
    model: Model,
    cameras: Cameras = "auto",
    *,
    views: int = VIEWS,
    pixels: int | tuple[int, int] = PIXELS,
    up: Sequence[float] | None = None,
    threads: int | None = None,
    max_memory: int | str | None = None,
    progress: Progress | bool | None = None,
) -> DrawCost:
    """Measure the cost of drawing a model, which depends on more than its number of splats.

    Merged splats are larger: half as many may cover each pixel as often as before. The default
    views are those of `compare`. A model of any size is possible, because it is read in blocks of
    rows.

    Args:
        model: The model, or a path.
        cameras: Cameras, or how to choose them; see `render`.
        views: Number of automatic views.
        pixels: Size of an automatic view: one number for both width and height, or both.
        up: (3,) up direction of automatic views in scene coordinates; found from the model by
            default.
        threads: Number of threads; all by default. The result does not depend on it.
        max_memory: Bytes of memory that this process may use, a number or text such as "4GB"; by
            default the free memory, less a tenth.
        progress: True for a bar, in a notebook or on a terminal, or a function that is called with
            each `nanogs.progress.Step`.

    Returns:
        The number of splats per pixel, of tile pairs, and the share of the largest splats in them.

    Raises:
        FormatError: The model or the cameras cannot be read.
        ModelError: Nothing of the model is visible, so that no views are found.
        NotEnoughMemoryError: Measuring takes more memory than is free or allowed.
        OptionError: An argument is out of range.
    """
    wanted = known_cameras(cameras, up, views, pixels)
    limit = None if max_memory is None else as_bytes(max_memory)
    with opened(model) as source:
        budget = budget_for_pictures(
            source, *pictures_of(wanted, views, pixels), limit, remedy=rendering_remedy(wanted)
        )
        some = source_of(source).load() if budget is None else source
        # Imported late, because these import Numba.
        from nanogs.threads import use_threads
        from nanogs.views.covering import cost_on

        with use_threads(threads), show_progress(progress) as on_step:
            tracker = Tracker(on_step, [Stage("cameras", 1.0), Stage("cover", 4.0)])
            tracker.begin("cameras")
            chosen, kind = chosen_cameras(some, wanted, views, pixels, up)
            tracker.begin("cover")
            cost = cost_on(some, chosen, protocol_of(chosen, kind), tracker.part)
            tracker.finish()
    return cost


def protocol_of(
    cameras: Sequence[Camera], kind: Kind, split: str = "test", background: Background = BLACK
) -> Protocol:
    """Return the protocol that describes some views in reports.

    Args:
        cameras: The views.
        kind: Source of the views.
        split: Split of automatic views or photographs, "test" or "train"; not used for given ones.
        background: RGB in [0, 1] behind the splats.
    """
    sizes = [(camera.width, camera.height) for camera in cameras]
    given = None if kind == "given" else split
    return Protocol(len(cameras), sizes[0], kind, given, background, len(set(sizes)))


def pictures_of(
    wanted: str | list[Camera], views: int = VIEWS, pixels: int | tuple[int, int] = PIXELS
) -> tuple[int, int]:
    """Return the pixels of the largest view and the number of views.

    Args:
        wanted: From `cameras.known_cameras`.
        views: Number of automatic views; not used for given ones.
        pixels: Size of automatic views; not used for given ones.
    """
    if not isinstance(wanted, str):
        return max(camera.width * camera.height for camera in wanted), len(wanted)
    width, height = picture_size(pixels)
    return width * height, view_count(views)
