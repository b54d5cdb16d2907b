"""Computing the visibility of each block's splats in the views of the scene.

All other blocks are rendered with a block, so that they hide it where they should.
"""

from collections.abc import Sequence
from dataclasses import replace

from nanogs.errors import SmallViewError
from nanogs.method.visibility import missed_light_of
from nanogs.metrics._ssim import LEAST
from nanogs.pipeline.scene import Look, Scene, Task, ViewLight
from nanogs.raster.camera import Camera
from nanogs.raster.light import LightSums
from nanogs.raster.rendering import concatenated, prepare
from nanogs.store.tables import Record
from nanogs.views.light import SHOWN, contributions_of, light_in, visibility_of


def look_at_block(scene: Scene, task: Task) -> Record:
    """Compute the visibility of each of a block's splats, and how much of the block a view shows.

    Raises:
        SmallViewError: A view by which results are to be chosen is too small to compare them.
    """
    own, views = scene.bare(task.number), scene.views
    count = len(own.splats)
    cameras = [*views.kept, *scene.closer_views(own)]
    drawn = concatenated(prepare(own.splats), scene.occluders(task.number)).with_buffers()
    sums, lights = LightSums(len(drawn)), []
    pictured = scene.pictured
    total = len(cameras) + len(pictured) + len(views.around)
    for done, camera in enumerate(cameras):
        scene.on_progress(done, total)
        light = scene.draw(drawn, camera)
        sums.add(light, SHOWN)
        lights.append(ViewLight(camera, light.total(count)))
        del light
    looked = contributions_of(sums, cameras)
    del sums
    for done, camera in enumerate(pictured, len(cameras)):
        scene.on_progress(done, total)
        scene.picture(drawn, camera)
    scene.on_progress(len(cameras) + len(pictured), total)
    around = light_in(drawn, views.around) if views.around else None
    del drawn
    visible, missed = visibility_of(looked, around)
    # Values of the block alone: the rows after `count` belong to its surroundings.
    own = replace(own, visible=visible[:count])
    missed_light = missed_light_of(looked, count)
    record = scene.keep_look(task.name, Look(own, missed[:count], lights, missed_light))
    if scene.guided:
        _refuse_small_views(scene.deciding)
    return record


def _refuse_small_views(deciding: Sequence[Camera]) -> None:
    """Raise, before the forest is grown, if a view is too small for scoring candidates."""
    for camera in deciding:
        if min(camera.width, camera.height) < LEAST:
            raise SmallViewError(
                f"The view of camera {camera.name!r} has {camera.width} x {camera.height} pixels"
                f" here, but results are chosen by views of at least {LEAST} x {LEAST}; raise"
                " `view_size` if it makes views smaller, or leave the camera out."
            )
