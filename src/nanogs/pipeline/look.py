"""The views of a scene, and what they show of each block, with all others before and behind it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from nanogs.errors import ModelError, OptionError
from nanogs.fit.views import choose_cameras
from nanogs.method.visibility import Light, discovery_of, light_in, roaming_views, visibility_of
from nanogs.metrics._ssim import LEAST
from nanogs.pipeline.scene import Lit, Scene
from nanogs.pipeline.views import Views
from nanogs.raster.lens import lens_notes
from nanogs.raster.rendering import prepare, together
from nanogs.store.tables import Record

if TYPE_CHECKING:
    from nanogs.raster.camera import Camera


def choose_views(scene: Scene) -> Views:
    """Choose the views of the whole scene, or take those asked for.

    Args:
        scene: With its coarse levels, if it has other blocks.
    """
    parameters, some = scene.settings.parameters, scene.sample()
    try:
        given = scene.given_cameras(some)
        kept, further = choose_cameras(
            some, given, parameters.views, parameters.further if parameters.steps else 0,
            parameters.view_size,
        )  # fmt: skip
    except ModelError as error:
        return Views((), (), (), (f"Nothing was measured: {error}",))
    roaming: list[Camera] = []
    notes: tuple[str, ...] = tuple(lens_notes(given or ()))
    if parameters.roaming and not given:
        roaming, notes = roaming_views(scene.from_afar(), parameters.roaming)
    return Views(tuple(kept), tuple(further), tuple(roaming), notes)


def look_at_block(scene: Scene, name: str, number: int) -> Record:
    """Find how visible each of a block's splats is, and how much of the block each view shows.

    Args:
        scene: With its views.
        name: Of what is kept.
        number: Of the block.

    Raises:
        OptionError: A view that results are to be chosen by is too small to compare them.
    """
    own, views = scene.bare(number), scene.views
    count = len(own.splats)
    cameras = [*views.kept, *scene.closer_views(own)]
    drawn = together(prepare(own.splats), scene.hiding(number)).in_turn()
    looked, lights = Light(len(drawn)), []
    pictured = scene.pictured
    total = len(cameras) + len(pictured) + len(views.roaming)
    for done, camera in enumerate(cameras):
        scene.tell(done, total)
        view = scene.draw(drawn, camera)
        looked.add(view)
        assert view.contributions is not None  # noqa: S101 - asked for
        lights.append(Lit(camera, float(view.contributions[:count].sum())))
        del view
    for done, camera in enumerate(pictured, len(cameras)):
        scene.tell(done, total)
        scene.picture(drawn, camera)
    scene.tell(len(cameras) + len(pictured), total)
    anywhere = light_in(drawn, views.roaming) if views.roaming else None
    del drawn
    visible, missed = visibility_of(looked, anywhere)
    # The surroundings' are not asked for.
    own, discovery = replace(own, visible=visible[:count]), discovery_of(looked, anywhere, count)
    record = scene.keep_look(name, own, missed[:count], lights, discovery)
    if scene.measures:
        _refuse_small(scene.deciding)
    return record


def _refuse_small(deciding: Sequence["Camera"]) -> None:
    """Refuse views that no candidate can be judged by, before the forest is grown."""
    for camera in deciding:
        if min(camera.width, camera.height) < LEAST:
            raise OptionError(
                f"The view of camera {camera.name!r} is {camera.width} x {camera.height} pixels"
                f" here, and results are chosen by views of {LEAST} x {LEAST} or more; raise"
                " `view_size` where it makes views smaller, or leave the camera out."
            )
