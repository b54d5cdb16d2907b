"""Files for the web, opened in web viewers of others: three real scenes each.

Their pictures are compared with our own rendering from the same camera. These viewers rasterise
and sort by depth in other ways, but position, orientation and colours of the model must agree.
"""

import pytest

import nanogs
from cesium_page import render_in_cesium
from conftest import scene_path
from nanogs import io
from nanogs.lod.layout import LodLayout
from nanogs.metrics import psnr
from nanogs.raster.rendering import render
from spark_page import render_in_spark
from supersplat_page import camera_options, render_in_supersplat
from views_and_scores import opening_camera

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("one_tab"),
    pytest.mark.filterwarnings("default"),  # warnings of the browser's driver
]
SPLATS = 3_000  # of each scene, so few that rendering on a CPU is fast
LEVELS = (1.0, 0.25)
WIDTH, HEIGHT = 160, 120
MIN_PSNR = 25.0  # dB between a viewer's picture and our rendering
CHUNKS = ("1_0/meta.json", "0_0/meta.json")
# An object, an object in another coordinate frame, and one with view-dependent colours.
SCENES = {"biker": "biker.spz", "plant": "plant.splat", "skull": "skull.sog"}


@pytest.fixture(scope="module", params=SCENES)
def model_and_camera(request):
    """A scene with fewer splats, and a camera that looks at it."""
    whole = nanogs.load(scene_path(SCENES[request.param]))
    model, _ = nanogs.simplify(whole, count=SPLATS, preset="fast")
    return model, opening_camera(model, WIDTH, HEIGHT, up=(0, -1, 0))


def assert_same(picture, model, camera):
    """Check that a picture shows the model, and matches less if it is flipped or recoloured."""
    rendered = render(model, camera).shown()
    closeness = psnr(picture, rendered)
    assert closeness > MIN_PSNR
    assert (rendered.max(axis=2) > 0.05).mean() > 0.04
    for other in (picture[::-1], picture[:, ::-1], picture[..., ::-1]):
        assert psnr(other, rendered) < closeness - 1


def test_supersplat_loads_a_streamed_model_from_coarse_to_fine(model_and_camera, tmp_path):
    """It requests the coarsest level first, and ends with the finest."""
    model, camera = model_and_camera
    path = tmp_path / "web" / "lod-meta.json"
    nanogs.write_levels(model, path.parent, LEVELS, layout=LodLayout.SOG, preset="fast")
    start = camera_options(camera)
    picture, requests = render_in_supersplat(path, tmp_path, SPLATS, WIDTH, HEIGHT, **start)
    assert requests == [f"scene/{name}" for name in ("lod-meta.json", *CHUNKS)]
    assert_same(picture, io.load(path, level=0), camera)


def test_spark_draws_a_rad_file_with_levels_of_detail(model_and_camera, tmp_path):
    model, camera = model_and_camera
    path = tmp_path / "model.rad"
    nanogs.write_levels(model, path, LEVELS, layout=LodLayout.TREE, preset="fast")
    picture, state = render_in_spark(path, camera, tmp_path, mesh={"paged": True}, lodRenderScale=0)
    assert state["splats"] == SPLATS
    assert_same(picture, model, camera)


def test_spark_draws_a_quantised_spz_file(model_and_camera, tmp_path):
    """With few bits, the file is of another version of the format and sorted in another order."""
    model, camera = model_and_camera
    path = tmp_path / "model.spz"
    nanogs.save(model, path, format_options={"bits": 6})
    picture, state = render_in_spark(path, camera, tmp_path)
    assert state["total"] == SPLATS
    assert_same(picture, model, camera)


def test_cesium_draws_3d_tiles(model_and_camera, tmp_path):
    model, camera = model_and_camera
    path = tmp_path / "tiles" / "tileset.json"
    nanogs.write_levels(model, path.parent, LEVELS, layout=LodLayout.TILES, preset="fast")
    picture, state = render_in_cesium(path, camera, tmp_path)
    assert state["splats"] == SPLATS
    assert set(state["requests"]) == {"scene/1_0.glb", "scene/0_0.glb"}
    assert_same(picture, model, camera)
