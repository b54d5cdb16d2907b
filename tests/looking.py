"""A model as the stages see it, once it has been looked at, and what views show of models."""

import numpy as np

import nanogs
from nanogs.metrics import psnr, ssim
from nanogs.pipeline.one_block import OneBlock, whole_settings
from nanogs.pipeline.scene import Task
from nanogs.pipeline.stages import do
from nanogs.raster.rendering import render


def looked(splats, cameras, parameters):
    """The scene after the stages that look."""
    settings = whole_settings(splats, parameters)
    scene = OneBlock(splats, np.arange(len(splats), dtype=np.int32), settings, 1, cameras)
    for stage in ("frame", "views", "look"):
        do(scene, Task(stage))
    return scene


def judged(small, scene):
    """Mean PSNR and SSIM of a result on the views that decide."""
    scores = []
    for target in scene.pictures(0, None):
        wanted = target.image[..., :3] / np.float32(255)
        shown = render(small, target.camera).shown()
        scores.append((psnr(wanted, shown), ssim(wanted.mean(axis=2), shown.mean(axis=2))))
    return np.mean(scores, axis=0)


def marks(one, other, cameras):
    """Mean PSNR and SSIM of a model against another, in the plainest way."""
    pairs = list(zip(*(nanogs.render(model, cameras) for model in (one, other)), strict=True))
    return [float(np.mean([metric(a, b) for a, b in pairs])) for metric in (psnr, ssim)]
