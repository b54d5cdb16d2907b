"""The kernels for a graphics card, on one or else on Warp's CPU device, and the CPU's compared."""

import dataclasses
import importlib
import json
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nanogs
from conftest import CARD, made_on_the_device, scene_path
from launch import run
from nanogs.card.device import engine_in_use, use_device
from nanogs.datasets.plant import load_plant
from nanogs.errors import NotEnoughMemoryError
from nanogs.fit.targets import ALPHA, WHITE, compute_gradients, make_target, picture_on
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.kernels.gradients import SCALES
from nanogs.kernels.project import MIN_ALPHA
from nanogs.metrics import psnr
from nanogs.raster.light import LightSums, light_in_view, render_with_light
from nanogs.raster.rendering import prepare, render, view_on
from nanogs.splats import RenderMode
from nanogs.views.automatic import automatic_cameras
from test_raster import make_camera, make_splats, one_splat

wp = pytest.importorskip("warp", reason="pip install 'nanogs[cuda]'")
NAMES = "advancing blending gradients lighting listing projecting shading".split()
advancing, blending, gradients, lighting, listing, projecting, shading = (
    importlib.import_module(f"nanogs.card.{name}") for name in NAMES
)

CLOSE = 100  # dB between both renderings if no splat is at a threshold


@pytest.fixture(autouse=True)
def card():
    """Use the device in every test; `render_on_cpu` renders with the CPU's kernels."""
    with use_device(CARD) as name:
        yield name


def render_on_cpu(*arguments, **options):
    with use_device("cpu"):
        return render(*arguments, **options)


def check_picture(splats, camera, **options):
    """Compare a picture of the card with the CPU's, and return the card's."""
    prepared = prepare(splats)
    background = (0.2, 0.5, 0.9)
    options = {"background": background, "depth": True, "contributions": True} | options
    on_card = render(prepared, camera, **options)
    on_cpu = render_on_cpu(prepared, camera, **options)
    # A splat whose alpha in a pixel is the least that is drawn, up to rounding, may be in one only.
    differences = np.abs(on_card.alpha - on_cpu.alpha)
    agree = differences < 1e-4
    assert agree.mean() > 0.995
    assert differences.max() < MIN_ALPHA
    assert psnr(on_card.color[agree], on_cpu.color[agree]) > CLOSE
    assert on_card.drawn == on_cpu.drawn
    assert (np.isinf(on_card.depth) == np.isinf(on_cpu.depth)).all()
    visible = agree & (on_cpu.alpha > 0.01)
    np.testing.assert_allclose(on_card.depth[visible], on_cpu.depth[visible], rtol=1e-4)
    np.testing.assert_allclose(
        on_card.contributions, on_cpu.contributions, rtol=1e-4, atol=MIN_ALPHA
    )
    np.testing.assert_allclose(on_card.unoccluded, on_cpu.unoccluded, rtol=1e-9)
    return on_card


@pytest.mark.parametrize("degree", range(5))
def test_pictures_agree_for_every_sh_degree(degree):
    check_picture(make_splats(200, degree=degree, seed=degree), make_camera(137, 91, 90.0))


@pytest.mark.parametrize(
    ("size", "spread"), [(-2, 2.5), (1.5, 0.5), (-6, 0.5)], ids=["needles", "huge", "tiny"]
)
def test_pictures_agree_for_splats_of_every_size(size, spread):
    check_picture(make_splats(300, size=size, spread=spread), make_camera(50, 33))


@pytest.mark.parametrize("mode", [RenderMode.MIP, RenderMode.SURFEL])
def test_pictures_agree_in_other_render_modes(mode):
    check_picture(make_splats(80, size=-3, render_mode=mode), make_camera())


@pytest.mark.parametrize("width", [1, 15, 16, 17, 100])
@pytest.mark.parametrize("height", [1, 16, 31])
def test_pictures_of_any_size_agree(width, height):
    check_picture(make_splats(80), make_camera(width, height))


def test_pictures_with_no_or_few_visible_splats_agree():
    for splats in (make_splats(0), one_splat(), one_splat(mean=(0, 0, -4)), one_splat(logit=-9)):
        check_picture(splats, make_camera())
    broken = make_splats(30)
    broken.means[3] = np.nan
    assert check_picture(broken, make_camera()).skipped == 1


def test_pictures_agree_in_double_precision_and_when_cropped():
    splats = make_splats(80)
    far = dataclasses.replace(splats, means=splats.means.astype(np.float64) + [5e6, 0, 0])
    pose = np.eye(4)
    pose[0, 3] = -5e6
    camera = make_camera(world_to_camera=pose)
    check_picture(far, camera)
    check_picture(far, camera.cropped(5, 3, 20, 11))


def test_blocks_that_are_not_requested_show_the_background():
    picture = check_picture(make_splats(80, size=0), make_camera(64, 48), wanted=FIELDS[0])
    assert (picture.alpha[:4, 4:8] == 0).all() != (picture.alpha[:4, :4] == 0).all()


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.integers(1, 90), st.floats(-4, 1))
def test_pictures_of_random_models_agree(seed, count, size):
    check_picture(make_splats(count, seed, size=size), make_camera())


@pytest.mark.parametrize("blocks", [ALL_BLOCKS, *FIELDS])
def test_gradients_agree(blocks):
    camera, small = make_camera(137, 91, 90.0), prepare(make_splats(100, seed=5, degree=2))
    target = make_target(prepare(make_splats(400, seed=3, degree=2)), camera)
    cpu = compute_gradients(small, target, blocks)
    view = view_on(engine_in_use(), small, camera)
    features = view.tinted(WHITE, ALPHA)
    image, _ = view.blend(features, np.zeros(4, np.float32), blocks)
    residual, precision, error = view.weigh(
        image, engine_in_use().put(target.image), WHITE, ALPHA, blocks
    )
    totals = view.gradients(features, image, residual, precision, blocks).numpy() * SCALES
    assert error == pytest.approx(cpu.error, rel=1e-6)
    rows = cpu.view.order
    largest = np.abs(cpu.totals[rows]).max(axis=0)
    assert (largest > 0).all()
    assert (np.abs(totals[rows] - cpu.totals[rows]).max(axis=0) < 1e-5 * largest).all()


@pytest.mark.parametrize("blocks", [ALL_BLOCKS, FIELDS[1]])
def test_targets_that_stay_on_the_device_are_those_that_are_copied_to_the_host(blocks):
    camera, prepared = make_camera(50, 33), prepare(make_splats(200, degree=2))
    target = make_target(prepared, camera, depth=False, wanted=blocks)
    on_device = view_on(engine_in_use(), prepared, camera).in_bytes(blocks).numpy()
    assert np.array_equal(on_device, target.image)
    assert target.image.any()


def test_repeated_renderings_have_the_same_bytes():
    prepared, camera = prepare(make_splats(200)), make_camera()
    first, second = (render(prepared, camera, contributions=True) for _ in range(2))
    assert first.color.tobytes() == second.color.tobytes()
    assert first.contributions.tobytes() == second.contributions.tobytes()


def test_a_model_stays_on_the_device_until_it_is_deleted():
    prepared, models = prepare(make_splats(20)), engine_in_use()._held
    before = len(models)
    render(prepared, make_camera())
    render(prepared, make_camera())
    assert len(models) == before + 1
    del prepared
    assert len(models) == before


@pytest.mark.parametrize("count", [200, 0])
def test_sums_of_light_agree(count):
    prepared = prepare(make_splats(count, degree=1))
    cameras = [make_camera(*sides, 40.0) for sides in ((50, 33), (20, 40), (33, 33))]

    def summed():
        sums = LightSums(count)
        for camera in cameras:
            light = light_in_view(prepared, camera)
            sums.add(light, 0.5)
        picture, light = render_with_light(prepared, cameras[0], depth=True)
        assert light.total(count // 2) == pytest.approx(light.contributions()[: count // 2].sum())
        return sums.contributions(), sums.unoccluded(), sums.times(), picture.color, picture.depth

    on_card = summed()
    with use_device("cpu"):
        on_cpu = summed()
    seen, whole, times, *pictures = zip(on_card, on_cpu, strict=True)
    np.testing.assert_allclose(*seen, rtol=1e-4, atol=3 * MIN_ALPHA)
    np.testing.assert_allclose(*whole, rtol=1e-9)
    assert count == 0 or 0.3 < np.mean(times[1] > 0) < 0.95
    assert count == 0 or set(times[1]) == {0, 1, 2}
    assert np.count_nonzero(times[0] != times[1]) <= 0.01 * count
    for made in pictures:
        np.testing.assert_allclose(*made, rtol=1e-4, atol=1e-4)


def test_the_picture_of_a_target_stays_on_the_device_until_the_target_is_deleted():
    engine = engine_in_use()
    target = make_target(prepare(make_splats(20)), make_camera(), depth=False)
    first = picture_on(engine, target)
    assert np.array_equal(first.numpy(), target.image)
    assert picture_on(engine, target) is first
    before = len(engine._held)
    del target
    assert len(engine._held) == before - 1


@pytest.mark.parametrize("name", ["plant", "guitar.compressed.ply"])
def test_pictures_of_real_scenes_agree(name):
    splats = load_plant() if name == "plant" else nanogs.load(scene_path(name))
    prepared = prepare(splats)
    for camera in automatic_cameras(splats, 2, width=96, height=72):
        on_card, on_cpu = render(prepared, camera), render_on_cpu(prepared, camera)
        assert psnr(on_card.color, on_cpu.color) > 80  # a few splats are at a threshold
        assert abs(on_card.drawn - on_cpu.drawn) <= 1


def test_a_full_card_memory_raises_an_error_that_suggests_the_cpu():
    with (
        pytest.raises(NotEnoughMemoryError, match='use `device="cpu"`'),
        use_device(CARD),
    ):
        raise RuntimeError("Failed to allocate 4 bytes on device 'cuda:0'")
    with pytest.raises(RuntimeError, match="something else"), use_device(CARD):
        raise RuntimeError("something else")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no compiler for cards there")
def test_kernels_compile_for_a_card_on_a_machine_without_one(tmp_path):
    """All that can be tested without a card: compiling in blocks as on a card, for old ones."""
    modules = [shading, projecting, listing, blending, lighting, gradients, advancing]
    blocks = {wp.get_module(module.__name__): 256 for module in modules}
    blocks |= {
        kernel_of(shading.WARP).module: shading.WARP
        for kernel_of in (gradients.share_kernel, gradients.pull_kernel)
    }
    for module, threads in blocks.items():
        module.options["block_dim"] = threads
        [binary] = wp.compile_aot_module(module, arch=75, module_dir=tmp_path)
        assert binary.stat().st_size > 1000


def test_the_command_reports_the_device_that_it_used(tmp_path):
    nanogs.save(make_splats(60), tmp_path / "a.ply")
    arguments = (tmp_path / "a.ply", "--device", CARD, "--json")
    result = run("render", *arguments[:1], tmp_path / "out", "--views", 1, "--pixels", 32,
                 *arguments[1:])  # fmt: skip
    report = json.loads(result.stdout)
    assert report["device"].startswith(CARD)
    assert made_on_the_device(report["notes"])
    result = run("compare", *arguments[:1], *arguments, "--views", 2, "--pixels", 32)
    report = json.loads(result.stdout)
    assert report["models"][0]["psnr"] == "inf"
    assert made_on_the_device(report["notes"])
