"""Trained models, and results of other tools for them; skipped if the files are absent."""

from functools import cache

import numpy as np
import pytest

import nanogs
from conftest import peer_path, scene_path
from nanogs.raster.rendering import prepare, render
from nanogs.scoring.comparison import NamedModel, compare_models
from nanogs.views.automatic import automatic_cameras

SCENES = {
    "biker": ("biker.compressed.ply", 152_746),
    "guitar": ("guitar.compressed.ply", 90_854),
    "plant": ("plant.splat", 113_648),
    "seal": ("seal.splat", 101_780),
    "chair": ("chair.splat", 111_650),
}


@cache
def tenth(name):
    """Return a scene, its tenth and the report; with a small fit if its quality is not tested."""
    splats = nanogs.load(scene_path(SCENES[name][0]))
    small_fit = {} if name in ("biker", "plant") else {"steps": 4, "view_size": 256}
    return splats, *nanogs.simplify(splats, ratio=0.1, **small_fit)


@pytest.mark.parametrize("name", SCENES)
def test_a_tenth_has_the_exact_count_and_survives_a_file(name, tmp_path):
    count = SCENES[name][1]
    splats, small, report = tenth(name)
    assert len(splats) == count
    assert len(small) == report.achieved_count == -(-count // 10)
    assert report.dropped_nonfinite == 0
    assert small.finite().all()
    nanogs.save(small, tmp_path / "small.ply")
    assert np.array_equal(nanogs.load(tmp_path / "small.ply").sh, small.sh)


@pytest.mark.parametrize(("name", "count"), [("biker", 198), ("guitar", 667)])
def test_infinite_opacities_of_real_files_are_kept(name, count):
    splats = nanogs.load(scene_path(SCENES[name][0]))
    assert (splats.opacity_logits == np.inf).sum() == count
    kept, _ = nanogs.simplify(splats, ratio=1)
    assert (kept.opacity_logits == np.inf).sum() == count


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "seeds"), [(0.1, 1), (0.01, 2), (0.001, 3)])
def test_as_good_as_the_published_code(ratio, seeds):
    """The mean over scenes and seeds is at most 0.3 dB lower.

    With 100 splats left, the seed alone changes one scene by up to half a decibel, so neither a
    single scene nor a single seed is enough. With 10,000 left, it changes the mean of the scenes by
    a tenth of a decibel, and that mean is half a decibel above the limit.
    """
    differences = []
    for name in ("biker", "plant", "seal", "chair"):
        splats = nanogs.load(scene_path(SCENES[name][0]))
        theirs = nanogs.load(peer_path(f"{name}_{ratio:g}_nanogs-ref.ply"))
        ours = [
            nanogs.simplify(splats, ratio=ratio, preset="paper", seed=seed)[0]
            for seed in range(seeds)
        ]
        assert all(len(model) == len(theirs) for model in ours)
        up = (0, 0, 1) if name == "chair" else None
        cameras = automatic_cameras(splats, 4, width=192, height=192, up=up, split="test")
        models = [NamedModel("", model) for model in (theirs, *ours)]
        comparison, _ = compare_models(NamedModel(name, splats), models, cameras)
        published, *scores = (model.psnr for model in comparison.models)
        differences.append(np.mean(scores) - published)
    assert np.mean(differences) > -0.3, differences


# Required lead of the default preset over the better peer, dB: about half of the measured one.
LEADS = {("biker", 0.1): 1.0, ("biker", 0.01): 0.6, ("plant", 0.1): 2.0, ("plant", 0.01): 0.5}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["biker", "plant"])
def test_better_than_the_peers_and_as_bright_as_the_original(name):
    """Mean PSNR on held-out views, and mean colour at a tenth of the splats.

    In views of 512 pixels the mean of each channel may be off by 1/255. In smaller views, which the
    method does not render, rasterisers widen the original's thin splats more than merged ones.
    """
    splats, small, _ = tenth(name)
    cameras = automatic_cameras(splats, 4, width=256, height=256, split="test")
    for ratio in (0.1, 0.01):
        ours = small if ratio == 0.1 else nanogs.simplify(splats, ratio=ratio)[0]
        peers = [nanogs.load(peer_path(f"{name}_{ratio:g}_st-{kind}.ply"))
                 for kind in ("uniform", "adaptive")]  # fmt: skip
        models = [NamedModel("", model) for model in (ours, *peers)]
        comparison, _ = compare_models(NamedModel(name, splats), models, cameras)
        score, *theirs = (model.psnr for model in comparison.models)
        assert score - max(theirs) > LEADS[name, ratio], (score, theirs)
        if ratio == 0.1:
            means = [
                [np.clip(render(prepared, camera).color, 0, 1).mean(axis=(0, 1), dtype=np.float64)
                 for camera in (camera.resized(512, 512) for camera in cameras)]
                for prepared in (prepare(splats), prepare(ours))
            ]  # fmt: skip
            assert np.abs(np.subtract(*means)).max() < 1 / 255
