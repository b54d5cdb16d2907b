"""Files for the web in the programs that show them there: three real scenes each.

Pictures are held against our own render of the same camera: other rasterisers, other sorts of
depth, but the same model at the same place, the same way up, in the same colours.
"""

import pytest

import nanogs
from cesiumpage import in_cesium
from conftest import scene_path
from looking import seen_from_the_start
from nanogs import io
from nanogs.lod.layout import Layout
from nanogs.metrics import psnr
from nanogs.raster.rendering import render
from sparkpage import in_spark
from supersplatpage import in_supersplat, standing_at

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("default"),  # the driver's own warnings are not ours
]
SPLATS = 8_000  # of a scene, so that a processor draws it in moments
LEVELS = (1.0, 0.25)
WIDTH, HEIGHT = 240, 180
LEAST = 25.0  # dB
CHUNKS = ("1_0/meta.json", "0_0/meta.json")
# An object, one in a frame of its own, and one whose colours depend on the view.
SCENES = {"biker": "biker.spz", "plant": "plant.splat", "skull": "skull.sog"}


@pytest.fixture(scope="module", params=SCENES)
def seen(request):
    """A scene with fewer splats, a camera before it, and our picture of it."""
    whole = nanogs.load(scene_path(SCENES[request.param]))
    model, _ = nanogs.simplify(whole, count=SPLATS, preset="fast")
    return model, seen_from_the_start(model, WIDTH, HEIGHT, up=(0, -1, 0))


def assert_same(shown, model, camera):
    """And a picture of another orientation, or of other colours, is told from it."""
    rendered = render(model, camera).shown()
    same = psnr(shown, rendered)
    assert same > LEAST
    assert (rendered.max(axis=2) > 0.05).mean() > 0.04
    for other in (shown[::-1], shown[:, ::-1], shown[..., ::-1]):
        assert psnr(other, rendered) < same - 1


def test_supersplat_walks_through_a_stream(seen, tmp_path):
    """From the coarsest level, which it asks for first, to the finest."""
    model, camera = seen
    path = tmp_path / "web" / "lod-meta.json"
    nanogs.write_levels(model, path.parent, LEVELS, layout=Layout.SOG, preset="fast")
    start = standing_at(camera)
    shown, asked = in_supersplat(path, tmp_path, SPLATS, WIDTH, HEIGHT, **start)
    assert asked == [f"scene/{name}" for name in ("lod-meta.json", *CHUNKS)]
    assert_same(shown, io.load(path, level=0), camera)


def test_spark_draws_a_tree(seen, tmp_path):
    model, camera = seen
    path = tmp_path / "model.rad"
    nanogs.write_levels(model, path, LEVELS, layout=Layout.TREE, preset="fast")
    shown, state = in_spark(path, camera, tmp_path, mesh={"paged": True}, lodRenderScale=0)
    assert state["splats"] == SPLATS
    assert_same(shown, model, camera)


def test_spark_draws_a_packed_file(seen, tmp_path):
    """One of few bits, which is of another version and in another order."""
    model, camera = seen
    path = tmp_path / "model.spz"
    nanogs.save(model, path, format_options={"bits": 6})
    shown, state = in_spark(path, camera, tmp_path)
    assert state["total"] == SPLATS
    assert_same(shown, model, camera)


def test_cesium_draws_tiles(seen, tmp_path):
    model, camera = seen
    path = tmp_path / "tiles" / "tileset.json"
    nanogs.write_levels(model, path.parent, LEVELS, layout=Layout.TILES, preset="fast")
    shown, state = in_cesium(path, camera, tmp_path)
    assert state["splats"] == SPLATS
    assert set(state["asked"]) == {"scene/1_0.glb", "scene/0_0.glb"}
    assert_same(shown, model, camera)
