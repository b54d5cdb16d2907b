"""Scenes after the stages that render views, scores of results, and the viewer's first camera."""

import dataclasses

import numpy as np

import nanogs
from nanogs.metrics import psnr, ssim
from nanogs.pipeline.one_block import OneBlock, whole_settings
from nanogs.pipeline.options.views import requested_views
from nanogs.pipeline.scene import Task
from nanogs.pipeline.stages import do
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import render
from nanogs.views.opening import opening_for
from nanogs.views.poses import look_at


def scene_with_views(splats, cameras, parameters, up=None):
    """Return the scene of a model after the stages units, views and look."""
    asked = requested_views(cameras, up)
    settings = dataclasses.replace(whole_settings(splats, parameters), asked=asked)
    scene = OneBlock(splats, np.arange(len(splats), dtype=np.int32), settings, 1)
    for stage in ("units", "views", "look"):
        do(scene, Task(stage))
    return scene


def mean_scores(small, scene):
    """Return the mean PSNR and SSIM of a result on the views that choose between candidates."""
    scores = []
    for target in scene.deciding_targets(None, None):
        reference = target.image[..., :3] / np.float32(255)
        shown = render(small, target.camera).shown()
        scores.append((psnr(reference, shown), ssim(reference.mean(axis=2), shown.mean(axis=2))))
    return np.mean(scores, axis=0)


def mean_psnr_ssim(one, other, cameras):
    """Return the mean PSNR and SSIM between the renderings of two models, computed simply."""
    pairs = list(zip(*(nanogs.render(model, cameras) for model in (one, other)), strict=True))
    return [float(np.mean([metric(a, b) for a, b in pairs])) for metric in (psnr, ssim)]


def opening_camera(model, width=240, height=180, up=None):
    """Return the camera that `nanogs view` opens with, for a picture of that size."""
    start = opening_for(model, up=up)
    pose = look_at(start.position, start.target, start.up)
    focal = min(width, height) / 2 / start.tangent
    near = start.near * start.distance
    return Camera(width, height, focal, focal, width / 2, height / 2, pose, near=near)
