"""Visibility of splats in views of the original, and its effect on a result."""

import dataclasses

import numpy as np
import pytest

import nanogs
from builders import random_splats
from nanogs.errors import OptionError
from nanogs.fit.shared import HIDDEN, weights_of_colours
from nanogs.fit.targets import Fitting, make_target
from nanogs.fit.views import choose_cameras
from nanogs.io import precision
from nanogs.kernels.blocks import ALL_BLOCKS, FIELDS
from nanogs.method import visibility
from nanogs.method.parameters import PICTURES, ForestParameters
from nanogs.pipeline import run
from nanogs.raster.camera import Camera
from nanogs.raster.light import HostLight, LightSums
from nanogs.raster.rendering import prepare
from nanogs.report import StopReason
from nanogs.splats import Splats, concatenate
from nanogs.views.automatic import all_around, automatic_cameras, cameras_of, survey
from nanogs.views.light import contributions_of, visible_weights
from nanogs.views.up_frame import ALL_AROUND, UPRIGHT
from views_and_scores import mean_scores, scene_with_views


def view_parameters(**given):
    """Return the parameters that views are chosen by."""
    return ForestParameters(**({"views": 14, "view_size": 768, "further": 0} | given))


def box_with_something_inside():
    """Return a box with opaque walls of splats, and one splat at its centre as the last row."""
    side = np.linspace(-1, 1, 13)
    u, v = (part.ravel() for part in np.meshgrid(side, side))
    walls = [
        np.insert(np.c_[u, v], axis, position, axis=1)
        for axis in range(3)
        for position in (-1.0, 1.0)
    ]
    means = np.r_[np.concatenate(walls), np.zeros((1, 3))].astype(np.float32)
    count = len(means)
    return Splats(
        means=means,
        log_scales=np.full((count, 3), np.log(0.12), np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacity_logits=np.full(count, 8.0, np.float32),
        sh=np.random.default_rng(6).normal(size=(count, 1, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("rows", [7, 1 << 15])
def test_light_is_added_in_all_slices(monkeypatch, rows):
    monkeypatch.setattr("nanogs.raster.light.SLICE_STEPS", rows)
    seen, whole = np.arange(20.0), np.full(20, 30.0)
    light = LightSums(20)
    for _ in range(3):
        light.add(HostLight(seen, whole), 0.01)
    assert np.array_equal(light.contributions(), 3 * seen)
    assert np.array_equal(light.unoccluded(), 3 * whole)
    assert light.times().tolist() == [0] + [2] * 19
    views = [Camera(3, 2, 1.0, 1.0, 0.0, 0.0, np.eye(4))] * 3
    summed = contributions_of(light, views)
    assert (summed.views, summed.pixels) == (3, 18)


def test_hidden_splats_get_a_low_weight_and_unseen_ones_a_full_weight():
    splats = box_with_something_inside()
    views = scene_with_views(splats, None, view_parameters())
    assert views.visible[-1] < 0.005
    assert np.median(views.visible[:-1]) > 0.05  # the splats of a wall hide each other too
    assert (views.visible <= 1).all()
    away = [dataclasses.replace(camera, world_to_camera=np.diag([-1.0, 1, -1, 1])
            @ camera.world_to_camera) for camera in automatic_cameras(splats, 1)]  # fmt: skip
    assert (scene_with_views(splats, away, view_parameters()).visible == 1).all()


@pytest.mark.parametrize("blocks", [{}, {"block": 400}])
def test_cameras_that_see_no_splats_are_noted_in_the_report(tmp_path, blocks):
    """For example cameras of another coordinate frame."""
    splats = box_with_something_inside()
    nanogs.save(splats, tmp_path / "in.ply")
    cameras = automatic_cameras(splats, 3, width=64, height=64)
    away = [
        dataclasses.replace(each, world_to_camera=np.diag([-1.0, 1, -1, 1]) @ each.world_to_camera)
        for each in cameras
    ]
    notes = []
    for index, views in enumerate((cameras, away)):
        report = nanogs.simplify_blocks(
            tmp_path / "in.ply", tmp_path / f"{index}.ply", ratio=0.5, cameras=views, steps=2,
            **blocks,
        )  # fmt: skip
        notes.append([note for note in report.notes if "No view shows the model" in note])
        assert (report.shown > 0) == (not notes[-1])
    assert list(map(len, notes)) == [0, 1]


@pytest.mark.parametrize("blocks", [{}, {"block": 400}])
@pytest.mark.parametrize(
    ("away", "views"), [([1, 3], "2 of the 4 views show"), ([3], "1 of the 4 views shows")]
)
def test_some_cameras_that_see_no_splats_are_noted_in_the_report(tmp_path, blocks, away, views):
    """In another frame some cameras may happen to see the model; the others are noted too."""
    splats = box_with_something_inside()
    nanogs.save(splats, tmp_path / "in.ply")
    cameras = automatic_cameras(splats, 4, width=64, height=64)
    for index in away:
        turned_away = np.diag([-1.0, 1, -1, 1]) @ cameras[index].world_to_camera
        cameras[index] = dataclasses.replace(cameras[index], world_to_camera=turned_away)
    report = nanogs.simplify_blocks(
        tmp_path / "in.ply", tmp_path / "out.ply", ratio=0.5, cameras=cameras, steps=2, **blocks
    )
    [found] = [note for note in report.notes if "nothing of the model" in note]
    assert found.startswith(f"{views} nothing of the model; ")
    assert "another frame" in found


def test_automatic_views_that_show_nothing_are_not_said_to_be_in_another_frame():
    splats = dataclasses.replace(random_splats(300), render_mode="mip")
    dots = dataclasses.replace(splats, log_scales=np.full((300, 3), -14.0))
    _, report = nanogs.simplify(dots, ratio=0.5, views=3, view_size=64, steps=0)
    [note] = [note for note in report.notes if "No view shows" in note]
    assert "may be too small or too faint" in note


def test_the_report_gives_the_visible_share_of_the_model():
    coverages, visible = np.array([2.0, 1.0, 1.0, 1.0]), np.array([1.0, 0.5, 1.0, 0.005])
    missed = np.array([False, False, True, False])
    assert visibility.shown_share(coverages, visible, missed) == pytest.approx(3 / 5)
    assert visibility.shown_share(np.zeros(4), visible, missed) == 0
    splats = box_with_something_inside()
    cameras = automatic_cameras(splats, 3, width=64, height=64)
    [every, one] = (
        nanogs.simplify(splats, ratio=0.5, cameras=chosen, steps=0)[1].shown
        for chosen in (cameras, cameras[:1])
    )
    assert 0.05 < one < every < 1
    assert nanogs.simplify(splats, ratio=0.5, preset="fast")[1].shown is None


def test_weights_of_hidden_splats_are_a_hundredth():
    weights = visible_weights(np.array([2.0, 2.0, 2.0]), np.array([1.0, 0.5, 0.0]), 0.01)
    assert weights == pytest.approx([2.0, 1.01, 0.02])


@pytest.mark.parametrize("whole_pictures", [True, False])
def test_colours_of_hardly_visible_splats_have_a_tenth_of_the_weight(whole_pictures):
    """Views are either scaled down, or cropped at full resolution."""
    splats = box_with_something_inside()
    cameras = automatic_cameras(splats, 3, width=300, height=300)
    if not whole_pictures:
        cameras = [camera.cropped(20, 20, 250, 250) for camera in cameras]
    fitting = Fitting([make_target(prepare(splats), camera) for camera in cameras])
    weights = weights_of_colours(splats, fitting) / precision.visibility(splats)
    assert weights[-1] == pytest.approx(HIDDEN, abs=0.01)
    assert 0.5 < weights.max() <= 1.0 + 1e-12
    # A splat that surrounding splats hide, and splats that no view sees.
    alone = splats.take(np.array([len(splats) - 1]))
    walls = prepare(splats.take(np.arange(len(splats) - 1)))
    beside = dataclasses.replace(fitting, surroundings=walls)
    [hidden] = weights_of_colours(alone, beside) / precision.visibility(alone)
    assert hidden == pytest.approx(weights[-1], abs=1e-6)
    assert weights_of_colours(alone, Fitting([])) == pytest.approx(precision.visibility(alone))


def test_the_original_scores_nearly_perfectly_and_one_view_in_six_validates():
    splats = box_with_something_inside()
    views = scene_with_views(splats, None, view_parameters(views=12))
    names = [f"fit_{i:03}" for i in range(12)]
    [group] = views.view_groups
    assert [view.camera.name for view in group.targets] == [names[3], names[9]]
    assert [view.camera.name for view in views.fitting] == names[:3] + names[4:9] + names[10:]
    psnr, ssim = mean_scores(splats, views)
    assert psnr > 57  # views are kept as 8 bits a channel
    assert ssim > 0.999
    assert mean_scores(splats.take(np.arange(100)), views)[0] < 30


def test_given_cameras_are_the_ones_rendered():
    splats = box_with_something_inside()
    cameras = automatic_cameras(splats, 3, width=1000, height=500)
    views = scene_with_views(splats, cameras, view_parameters(view_size=256))
    both = [*views.view_groups[0].targets, *views.fitting]
    assert {(view.camera.width, view.camera.height) for view in both} == {(256, 128)}
    assert {view.image.shape for view in both} == {(128, 256, 4)}
    assert len(both) == 3


def test_given_views_that_show_nothing_neither_decide_nor_are_fitted_to():
    splats = box_with_something_inside()
    cameras = automatic_cameras(splats, 16, width=64, height=64)
    away = np.diag([-1.0, 1, -1, 1])
    for index in range(0, 16, 2):
        turned = away @ cameras[index].world_to_camera
        cameras[index] = dataclasses.replace(cameras[index], world_to_camera=turned)
    views = scene_with_views(splats, cameras, view_parameters(views=8, view_size=48, further=8))
    used = [*views.fitting, *(view for group in views.view_groups for view in group.targets)]
    assert {view.camera.name for view in used} == {camera.name for camera in cameras[1::2]}
    blind = [camera for camera in cameras if camera.name not in {v.camera.name for v in used}]
    none = scene_with_views(splats, blind, view_parameters(views=8, view_size=48))
    assert len(none.view_groups) == 1  # nothing is better than the others


def test_further_views_differ_from_the_other_views():
    splats = box_with_something_inside()
    for cameras in (None, automatic_cameras(splats, 90, width=64, height=64)):
        for further in (9, PICTURES - 5):
            parameters = view_parameters(views=6, view_size=48, further=further)
            views = scene_with_views(splats, cameras, parameters)
            every = [view for group in views.view_groups for view in group.targets]
            every += [view for view in views.fitting if view.blocks == ALL_BLOCKS]
            cameras_of = [view.camera for view in every]
            assert (len(cameras_of), len(views.views.further)) == (6, further)
            names = {camera.name for camera in (*cameras_of, *views.views.further)}
            assert len(names) == 6 + further
            assert {camera.width for camera in (*cameras_of, *views.views.further)} == {48}
            assert len(views.fit_views(0, 0).fitting) == 5 + further
    few_views = scene_with_views(
        splats, cameras[:7], view_parameters(views=6, view_size=48, further=9)
    )
    assert len(few_views.views.further) == 1


@pytest.mark.parametrize("asked", [("auto", (0, 0, 1)), ("orbit", None), ("roam", None)])
def test_views_of_a_kind_are_as_many_as_automatic_ones(asked):
    splats = box_with_something_inside()
    parameters = view_parameters(views=4, view_size=48, further=3, around=2)
    found = scene_with_views(splats, asked[0], parameters, up=asked[1]).views
    assert (len(found.kept), len(found.further), len(found.around)) == (4, 3, 2)
    assert len({camera.name for camera in (*found.kept, *found.further)}) == 7
    still = dataclasses.replace(parameters, steps=0)
    assert len(scene_with_views(splats, asked[0], still, up=asked[1]).views.further) == 0


def test_few_further_views_are_kept_in_halves_and_many_are_not_kept():
    splats = box_with_something_inside()
    few_views = scene_with_views(splats, None, view_parameters(views=6, view_size=48, further=4))
    assert [view.blocks for view in few_views.fitting[5:]] == [*FIELDS, *FIELDS]
    names = [view.camera.name for view in few_views.fitting[5:]]
    assert names == [camera.name for camera in few_views.views.further]
    whole = scene_with_views(
        splats, None, view_parameters(views=6, view_size=48, further=4, halves=False)
    )
    assert [view.blocks for view in whole.fitting[5:]] == [ALL_BLOCKS] * 4
    assert (
        len(
            scene_with_views(
                splats, None, view_parameters(views=6, view_size=48, further=60)
            ).fitting
        )
        == 5
    )
    assert (
        len(scene_with_views(splats, None, view_parameters(views=6, steps=0, further=4)).fitting)
        == 5
    )
    assert [view_parameters(steps=steps, further=4).pictured for steps in (1, 0)] == [4, 0]


def test_a_single_view_only_validates_and_nothing_is_fitted():
    splats = random_splats(300)
    assert len(scene_with_views(splats, None, view_parameters(views=1)).view_groups) == 1
    _, report = nanogs.simplify(splats, ratio=0.5, views=1, further=0)
    assert report.fit is None
    assert any("not fitted" in note for note in report.notes)


def test_the_report_of_the_fit_gives_its_number_of_views():
    options = {"views": 8, "further": 0, "view_size": 48, "steps": 2}
    _, report = nanogs.simplify(random_splats(300), ratio=0.5, **options)
    parameters = report.fit.parameters
    assert parameters["views"] == len(report.fit.fit_views) == 7
    assert parameters["validation"] == len(report.fit.validation_views) == 1


def test_hidden_splats_are_merged_first():
    """Splats inside an opaque box are merged more than by a preset that renders nothing."""
    box = box_with_something_inside()
    outside = len(box) - 1
    means = np.random.default_rng(7).uniform(-0.4, 0.4, (400, 3)).astype(np.float32)
    both = box.take(np.r_[np.arange(outside), np.full(400, outside)])
    both.means[outside:] = means
    both.sh[outside:, 0] = np.random.default_rng(8).normal(size=(400, 3))
    small, _ = nanogs.simplify(both, ratio=0.3, steps=2)
    blind, _ = nanogs.simplify(both, ratio=0.3, preset="fast")
    inside = [(np.abs(model.means) < 0.6).all(axis=1).sum() for model in (small, blind)]
    assert inside[0] < 0.9 * inside[1]


def test_an_invisible_model_is_noted_and_still_reduced_to_the_count():
    splats = random_splats(100)
    splats.opacity_logits[:] = -7  # alpha 0.0009
    assert scene_with_views(splats, None, view_parameters()).views.kept == ()
    small, report = nanogs.simplify(splats, count=13)
    assert len(small) == 13
    assert report.stop == StopReason.TARGET
    assert report.candidates == ()
    said = [note.partition(":")[0] for note in report.notes]
    assert "Nothing was rendered or measured" in said
    assert nanogs.simplify(splats, count=13, preset="fast")[1].notes == ()


@pytest.mark.parametrize("asked", [{"cameras": "roam"}, {"up": (0, 0, 1)}])
def test_a_model_without_views_of_the_kind_is_still_reduced_to_the_count(asked, tmp_path):
    splats = random_splats(100)
    splats.opacity_logits[:] = -7  # alpha 0.0009
    nanogs.save(splats, tmp_path / "in.ply")
    for blocks in ({}, {"block": 50}):
        report = nanogs.simplify_blocks(
            tmp_path / "in.ply", tmp_path / f"{len(blocks)}.ply", count=13, **asked, **blocks
        )
        assert report.achieved_count == 13
        said = [note.partition(":")[0] for note in report.notes]
        assert "Nothing was rendered or measured" in said


def test_splats_seen_from_anywhere_around_are_not_hidden():
    """One view shows one side of the box; small views from all around show the others too."""
    splats = box_with_something_inside()
    given = automatic_cameras(splats, 5, width=48, height=48, habit=False)
    assert scene_with_views(splats, given, view_parameters(around=8)).views.around == ()
    alone, more = (
        scene_with_views(splats, None, view_parameters(views=1, view_size=48, around=count))
        for count in (0, 8)
    )
    assert (len(alone.views.around), len(more.views.around)) == (0, 8)
    assert (more.visible >= alone.visible).all()
    assert (more.visible > alone.visible).mean() > 0.1
    assert max(more.visible[-1], alone.visible[-1]) < 0.01, "inside the box"
    assert (alone.missed | ~more.missed).all()
    assert more.missed_light == alone.missed_light
    for name in ("view_groups", "fitting"):
        assert len(getattr(more, name)) == len(getattr(alone, name))


def test_views_from_all_around_look_in_other_directions_than_automatic_ones():
    splats = box_with_something_inside()
    views = scene_with_views(splats, None, view_parameters(views=4, further=3, around=5)).views
    cameras = [*views.kept, *views.further, *views.around]
    assert len({camera.name for camera in cameras}) == len(cameras) == 12
    directions = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    assert (directions @ directions.T - 2 * np.eye(12)).max() < 0.999


@pytest.mark.parametrize(
    ("kind", "band", "views", "asked", "small"),
    [
        ("orbit", ALL_AROUND, 4, None, 0),
        ("orbit", ALL_AROUND, 3, None, 4),
        ("orbit", UPRIGHT, 4, None, 4),
        ("inside", UPRIGHT, 4, None, 4),
        ("inside", ALL_AROUND, 4, None, 4),
        ("orbit", ALL_AROUND, 4, "roam", 4),
    ],
)
def test_no_small_views_where_enough_others_are_from_all_around(
    monkeypatch, kind, band, views, asked, small
):
    """They would show nothing new; three others, or views of a kind, may leave sides unseen."""
    splats = box_with_something_inside()
    analysed = dataclasses.replace(survey(splats), kind=kind, band=band)
    monkeypatch.setattr("nanogs.pipeline.tasks.views.survey", lambda *_, **__: analysed)
    parameters = view_parameters(views=views, view_size=48, around=4)
    assert len(scene_with_views(splats, asked, parameters).views.around) == small


def test_a_third_of_the_further_views_are_from_all_around():
    splats = box_with_something_inside()
    upright = dataclasses.replace(survey(splats), kind="orbit", band=UPRIGHT)
    kept, further = choose_cameras(upright, 4, 8, 32, 0.7)
    automatic = cameras_of(upright, range(12), 32, 32)
    around = cameras_of(all_around(upright), range(12), 32, 32)

    def positions(cameras):
        return [camera.position.tolist() for camera in cameras]

    assert positions(kept) == positions(automatic[:4])
    expected = [(around if i % 3 == 0 else automatic)[4 + i] for i in range(8)]
    assert positions(further) == positions(expected)
    assert [camera.name for camera in further] == [f"fit_{4 + i:03}" for i in range(8)]
    usual = automatic[0].dilation
    assert [camera.dilation for camera in kept] == [usual] * 4
    assert [camera.dilation for camera in further] == pytest.approx([usual * 0.7**3] * 8)
    _, few = choose_cameras(upright, 11, 1, 32, 0.7)
    assert few[0].dilation == pytest.approx(usual / 4)  # no finer
    up = upright.turn[2, :3]
    steepest = [max(abs(c.world_to_camera[2, :3] @ up) for c in s) for s in (automatic, around)]
    assert steepest[0] < 0.51 < 0.75 < steepest[1]


def test_too_few_views_of_the_kind_asked_for_are_noted(monkeypatch):
    splats = box_with_something_inside()
    few = automatic_cameras(splats, 3, width=48, height=48, habit=False)
    monkeypatch.setattr("nanogs.views.roam.roaming_cameras", lambda *_, **__: few)
    parameters = view_parameters(views=4, view_size=48, further=3)
    views = scene_with_views(splats, "roam", parameters).views
    assert views.notes == ("Only 3 of 7 roaming views could be found.",)
    assert len(views.kept) + len(views.further) == 3


@pytest.mark.parametrize("block", [None, 150])
def test_views_too_small_to_compare_results_are_refused_before_growing(
    block, tmp_path, monkeypatch
):
    path, stages, original_do = tmp_path / "a.ply", [], run.do
    nanogs.save(random_splats(300), path)
    cameras = automatic_cameras(nanogs.load(path), 3, width=160, height=20)
    options = {"ratio": 0.5, "cameras": cameras, "view_size": 64, "steps": 1}

    def noted(scene, task):
        stages.append(task.stage)
        return original_do(scene, task)

    def made(name, **more):
        if block is None:
            return nanogs.simplify(path, **options, **more)[1]
        return nanogs.simplify_blocks(path, tmp_path / name, block=block, **options, **more)

    monkeypatch.setattr(run, "do", noted)
    words = "'fit_001' has 64 x 8 pixels here, .* views of at least 11 x 11; raise `view_size`"
    with pytest.raises(OptionError, match=words):
        made("b.ply")
    assert stages[-1] == "look"
    assert "grow" not in stages
    assert made("c.ply", guided=False).achieved_count == 150


def rooms(count):
    """Return closed boxes in a row along x, and in each but the last a camera along x."""
    box, cameras = box_with_something_inside(), []
    model = concatenate([box] * count)
    model.means[:, 0] += np.repeat(3 * np.arange(count), len(box)).astype(np.float32)
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # rows: right, down, ahead
    for number in range(count - 1):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ (3 * number - 0.5, 0, 0)
        cameras.append(Camera(96, 96, 48, 48, 48, 48, pose, f"room_{number}", near=0.01))
    return model, cameras


@pytest.mark.parametrize("blocks", [False, True])
def test_unseen_splats_do_not_count_as_hidden_if_views_overlap_little(
    tmp_path, monkeypatch, blocks
):
    model, cameras = rooms(4)
    nanogs.save(model, tmp_path / "in.ply")
    counts = []
    for new in (visibility.NEW, 1.0):  # 1.0: as if no view could leave anything out
        monkeypatch.setattr(visibility, "NEW", new)
        options = {"ratio": 0.1, "cameras": cameras, "steps": 0, "view_size": 96}
        if blocks:
            nanogs.simplify_blocks(
                tmp_path / "in.ply", tmp_path / "out.ply", block=1500, overwrite=True, **options
            )
            small = nanogs.load(tmp_path / "out.ply")
        else:
            small, _ = nanogs.simplify(model, **options)
        counts.append(np.count_nonzero(small.means[:, 0] > 7.5))
    assert counts[0] > 1.5 * counts[1]


def test_missed_light_is_estimated_from_splats_in_a_single_view():
    def summed(views, pixels):
        light = LightSums(5)
        for contributions, unoccluded in views:
            light.add(HostLight(np.array(contributions, float), np.array(unoccluded)), 0.01)
        cameras = [Camera(pixels, 1, 1.0, 1.0, 0.0, 0.0, np.eye(4))] * len(views)
        return contributions_of(light, cameras)

    # Splats: in two views; in one; in none; almost hidden (below 0.01); of another block.
    unoccluded = [50, 20, 30, 40, 9]
    views = [([40, 0, 0, 0.1, 9], unoccluded), ([10, 0, 0, 0, 0], unoccluded)]
    from_views = summed(views, pixels=100)
    alone = visibility.missed_light_of(from_views, 4)
    assert dataclasses.astuple(alone) == pytest.approx((0.0, 0.501, 1.8))
    small = summed([([0, 4, 0, 0, 0], [1, 4, 5, 0, 0])], pixels=10)
    both = alone + visibility.missed_light_of(small, 4)
    assert dataclasses.astuple(both) == pytest.approx((0.4, 0.901, 2.4))
    assert both.hidden(0.03) == pytest.approx(0.4 / 2.4)
    assert both.hidden(0.5) == 0.5
    assert (both + visibility.MissedLight(0.0, 0.099, 1.6)).hidden(0.03) == pytest.approx(0.1)
    assert visibility.MissedLight(0.009, 1.0, 0.1).hidden(0.03) == 0.03  # everything has been seen
    assert visibility.MissedLight(0.011, 1.0, 0.1).hidden(0.03) == pytest.approx(0.11)
    assert visibility.MissedLight(3.0, 4.0, 0.1).hidden(0.03) == 1.0
    assert visibility.MissedLight(3.0, 4.0, 0.0).hidden(0.03) == 0.03
