"""Composite scenes for `quality.py`, most with synthetic ground, hills and sky.

    python benchmarks/unbounded.py FOLDER      # close views, with and without given cameras

None of the real scenes has a sky or hills, as most outdoor captures have. `outdoors` is playbot
with plants around it; `meadow` is a plant among pieces of flowers, which have most of the splats;
`street` is eight objects along a road. Their unit is the radius that holds nine tenths of the first
model's centres, y down. `rooms` is four kitchens wall to wall. All are deterministic.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from nanogs import compare, load, save, simplify
from nanogs._types import F32, F64
from nanogs.activations import SH_C0, quaternions, rotations
from nanogs.method import viewers
from nanogs.raster.camera import Camera
from nanogs.splats import Splats, concatenate
from nanogs.views import inside
from nanogs.views.automatic import Split, automatic_cameras, survey
from nanogs.views.poses import look_at
from rivals import REAL_SCENES, install

UP = np.array([0.0, -1.0, 0.0])
# Rings of cameras around the centre: distance, height, and height of the point they look at.
RINGS = {"outdoors": (1.8, 1.1, 0.6), "meadow": (2.2, 1.3, 0.8)}
THINGS = ("playbot", "plant", "biker", "guitar", "plant", "playbot", "biker", "plant")
SAND, GREEN = (0.45, 0.38, 0.26), (0.25, 0.33, 0.22)
PRESETS = ("fast", "default", "best")
Source = Callable[[str], Path]


def outdoors(source: Source, rng: np.random.Generator) -> list[Splats]:
    """Return playbot, nine plants four to nine radii away, ground, hills and sky."""
    bot = standing(load(source("playbot")), 1.0, 0.0, 0.97)
    plant = load(source("plant"))
    found = [bot]
    for turn in 0.3 + np.arange(9) * 2 * np.pi / 9:
        far, size, spin = rng.uniform(4, 9), rng.uniform(1.2, 2.5), rng.uniform(0, 6)
        some = standing(thinned(plant, 0.35, rng), size, spin, 0.98)
        some.log_scales[:] += np.float32(0.3)
        found.append(moved(some, [far * np.cos(turn), 0, far * np.sin(turn)]))
    return [*found, ground(60_000, 1.2, SAND, rng), hills(15_000, 50, GREEN, rng), sky(rng)]


def meadow(source: Source, rng: np.random.Generator) -> list[Splats]:
    """Return a plant, four pieces of flowers, one of them around it, ground, hills and sky."""
    plant, flowers = load(source("plant")), load(source("flowers"))
    found = [standing(thinned(plant, 0.6, rng), 1.0, 0.0, 0.99)]
    for number, (x, z, size, share) in enumerate(
        [(0, 0, 4, 0.5), (12, 5, 6, 0.25), (-10, -9, 6, 0.25), (5, -14, 7, 0.25)]
    ):
        piece = standing(thinned(flowers, share, rng), size, 1.3 * number, 0.6)
        if number == 0:  # a hole for the plant
            level = np.linalg.norm(piece.means[:, [0, 2]], axis=1)
            piece = piece.take(np.flatnonzero((level > 1.2) | (piece.means[:, 1] > -0.1)))
        found.append(moved(piece, [x, 0.05, z]))
    grass = (0.3, 0.4, 0.15)
    return [*found, ground(30_000, 0.3, grass, rng), hills(15_000, 60, GREEN, rng), sky(rng)]


def street(source: Source, rng: np.random.Generator) -> list[Splats]:
    """Return eight objects six radii apart, on both sides of a road, ground, hills and sky."""
    found = []
    for number, name in enumerate(THINGS):
        thing = standing(thinned(load(source(name)), 0.5, rng), 1.0, 0.9 * number, 0.98)
        found.append(moved(thing, place_of(number)))
    return [*found, ground(40_000, 0.3, SAND, rng), hills(15_000, 50, GREEN, rng), sky(rng)]


def place_of(number: int) -> list[float]:
    """Return the position of an object of `street`."""
    return [6.0 * number - 21, 0.0, 3.0 if number % 2 else -3.0]


def rooms(source: Source, rng: np.random.Generator) -> list[Splats]:
    """Return four kitchens, two by two."""
    kitchen = load(source("kitchen"))
    offsets = room_offsets(kitchen)
    return [moved(thinned(kitchen, 0.6, rng), offset.tolist()) for offset in offsets]


def room_offsets(kitchen: Splats) -> F64:
    """Return the offsets (4, 3) of `rooms`: sums of the edges of the kitchen's bounding box."""
    found = survey(kitchen)
    box = inside.fit_box(found.sampled, found.core, np.array([0.0, 0.0, 1.0]))
    edges = (box.frame @ found.turn[:3, :3]) * (box.high - box.low)[:, None]
    return np.array([i * edges[0] + j * edges[1] for i in (0, 1) for j in (0, 1)])


SCENES: dict[str, Callable[[Source, np.random.Generator], list[Splats]]] = {
    "outdoors": outdoors,
    "meadow": meadow,
    "street": street,
    "rooms": rooms,
}


def make(name: str, source: Source, target: Path) -> None:
    """Write one of `SCENES`, made from real scenes; `source` returns the file of a name."""
    save(concatenate(SCENES[name](source, np.random.default_rng(5))), target)


def standing(model: Splats, size: float, spin: float, foot: float) -> Splats:
    """Put a model on the ground at the origin, without view-dependent colour, scaled and rotated.

    Args:
        model: A model with y down, like trained models.
        size: The radius that then holds nine tenths of its centres.
        spin: Rotation about the vertical, radians.
        foot: Quantile of its heights, from the top, that is placed at ground level.
    """
    model = model.with_sh_degree(0)
    middle = np.median(model.means, axis=0)
    scale = size / np.quantile(np.linalg.norm(model.means - middle, axis=1), 0.9)
    cos, sin = np.cos(spin), np.sin(spin)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    means = (model.means.astype(np.float64) - middle) @ turn.T * scale
    means[:, [0, 2]] -= np.median(means[:, [0, 2]], axis=0)
    means[:, 1] -= np.quantile(means[:, 1], foot)
    axes = turn @ rotations(model.unit_quats().astype(np.float64))
    return splats_of(means, model.log_scales + np.log(scale), axes, model.opacity_logits, model.sh)


def thinned(model: Splats, share: float, rng: np.random.Generator) -> Splats:
    """Return a random share of the splats."""
    return model.take(np.flatnonzero(rng.random(len(model)) < share))


def moved(model: Splats, offset: Sequence[float]) -> Splats:
    """Translate the model in place, and return it."""
    model.means[:] += np.array(offset, model.means.dtype)
    return model


def ground(count: int, least: float, colour: Sequence[float], rng: np.random.Generator) -> Splats:
    """Return a plane around the origin, from `least` to 60 radii, coarser with the distance."""
    distance = np.exp(rng.uniform(np.log(least), np.log(60), count))
    angle = rng.uniform(0, 2 * np.pi, count)
    points = np.stack(
        [distance * np.cos(angle), np.full(count, 0.05), distance * np.sin(angle)], axis=1
    )
    points[:, 1] += 0.01 * waves(points, [(3, 1.0)], 1)
    tones = 0.12 * waves(points, [(2, 0.3), (9, 0.2), (0.3, 0.4)], 2)
    shades = np.array(colour) + (tones + rng.normal(0, 0.05, count))[:, None]
    return surface(points, np.tile(UP, (count, 1)), 0.016 * distance, shades, 0.06, rng)


def hills(count: int, far: float, colour: Sequence[float], rng: np.random.Generator) -> Splats:
    """Return a ring of hills at a distance of `far`."""
    turn, height = rng.uniform(0, 2 * np.pi, count), rng.random(count)
    tops = far / 8 * (1 + 0.5 * np.sin(3 * turn) + 0.3 * np.sin(7 * turn + 1))
    ring = np.stack([np.cos(turn), np.zeros(count), np.sin(turn)], axis=1)
    points = far * ring + np.outer(height * tops, UP)
    tones = 0.08 * waves(points, [(0.5, 0.4), (2, 0.3)], 3) + rng.normal(0, 0.03, count)
    shades = np.array(colour) + tones[:, None]
    return surface(points, -ring, np.full(count, 0.01 * far), shades, 0.06, rng)


def sky(rng: np.random.Generator) -> Splats:
    """Return a hemisphere of large splats with clouds, 70 to 140 radii away."""
    ways = rng.normal(size=(12_000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ways = ways[ways[:, 1] < 0.08]
    far = rng.uniform(70, 140, len(ways))
    clouds = np.clip(waves(ways, [(3, 0.4), (8, 0.25)], 4), 0, 1)[:, None]
    blue = np.array([0.42, 0.6, 0.85]) * (1 - 0.25 * np.clip(-ways[:, 1:2], 0, 1))
    shades = blue + clouds * np.array([0.45, 0.33, 0.12])
    return surface(far[:, None] * ways, -ways, 0.022 * far, shades, 0.3, rng)


def surface(
    points: F64, normals: F64, widths: F64, shades: F64, flatness: float, rng: np.random.Generator
) -> Splats:
    """Return splats on a surface, with varying scales and opacities like those of trained models.

    Args:
        points: (N, 3) points on the surface.
        normals: (N, 3) unit normals.
        widths: (N,) typical scales along the surface.
        shades: (N, 3) RGB in [0, 1].
        flatness: Ratio of thickness to width.
        rng: Source of the random numbers.
    """
    count = len(points)
    widths = widths * np.exp(rng.normal(0, 0.5, count))
    long = np.sqrt(np.exp(np.abs(rng.normal(0, np.log(2.5), count))))
    thick = flatness * np.exp(rng.normal(0, 0.5, count))
    opaque = rng.random(count) < 0.55
    logits = np.where(opaque, rng.normal(3.5, 1.5, count), rng.normal(-1.0, 1.5, count))
    points = points + normals * (rng.normal(0, 0.15, count) * widths)[:, None]
    leaning = normals + rng.normal(0, 0.08, (count, 3))
    along = np.cross(leaning, rng.normal(size=(count, 3)))
    frames = np.stack([along, np.cross(leaning, along), leaning], axis=2)
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    scales = np.stack([widths * long, widths / long, widths * thick], axis=1)
    colours = (np.clip(shades, 0.01, 0.99) - 0.5) / SH_C0
    return splats_of(points, np.log(scales), frames, logits, colours[:, None])


def splats_of(
    means: F64, log_scales: F32 | F64, axes: F64, logits: F32 | F64, sh: F32 | F64
) -> Splats:
    """Build splats in float32 from columns, with the axes as columns of rotations (N, 3, 3)."""
    columns = (means, log_scales, quaternions(axes), logits, sh)
    centres, scales, quats, opacities, harmonics = (
        np.ascontiguousarray(column, np.float32) for column in columns
    )
    return Splats(centres, scales, quats, opacities, harmonics)


def waves(points: F64, sizes: Sequence[tuple[float, float]], seed: int) -> F64:
    """Compute noise (N,) as a sum of sines; `sizes` are pairs of frequency and amplitude."""
    rng, found = np.random.default_rng(seed), np.zeros(len(points))
    for frequency, height in sizes:
        for direction in rng.normal(size=(6, 3)):
            phase = rng.uniform(0, 2 * np.pi)
            found += height * np.sin(
                points @ direction * (frequency / np.linalg.norm(direction)) + phase
            )
    return found


def camera_at(position: F64, target: F64, name: str) -> Camera:
    """Return a camera of 400 x 400 pixels with a field of view of 60 degrees."""
    focal = 200 / np.tan(np.pi / 6)
    return Camera(400, 400, focal, focal, 200, 200, look_at(position, target, UP), name, near=0.02)


def ring(name: str, count: int, start: float) -> list[Camera]:
    """Return cameras in a ring around the centre of a scene."""
    distance, height, target = RINGS[name]
    found = []
    for angle in start + np.arange(count) * 2 * np.pi / count:
        position = np.array([distance * np.cos(angle), -height, distance * np.sin(angle)])
        found.append(camera_at(position, target * UP, f"{angle:.2f}"))
    return found


def cameras_along_street(count: int, start: float) -> list[Camera]:
    """Return `count` cameras near each object of `street`, on the side of the road."""
    found = []
    for number in range(len(THINGS)):
        thing = np.array(place_of(number)) + 0.5 * UP
        for angle in start + np.arange(count) * np.pi / count:
            direction = np.array([np.cos(angle), 0.0, -np.sign(thing[2]) * np.sin(angle)])
            found.append(
                camera_at(thing + 2.4 * direction + 0.6 * UP, thing, f"{number}_{angle:.2f}")
            )
    return found


def cameras_in_rooms(kitchen: Splats, count: int, split: Split) -> list[Camera]:
    """Return automatic cameras of 400 x 400 pixels in each of `rooms`."""
    found = []
    for number, offset in enumerate(room_offsets(kitchen)):
        for camera in automatic_cameras(kitchen, count, width=400, height=400, split=split):
            pose = camera.world_to_camera.copy()
            pose[:3, 3] -= pose[:3, :3] @ offset
            found.append(replace(camera, world_to_camera=pose, name=f"{number}_{camera.name}"))
    return found


def near_views(name: str, source: Source) -> tuple[list[Camera], list[Camera]]:
    """Return close views of a scene: those that methods may learn from, and those to test on."""
    if name == "street":
        return cameras_along_street(5, 0.3), cameras_along_street(2, 0.6)
    if name == "rooms":
        kitchen = load(source("kitchen"))
        return cameras_in_rooms(kitchen, 10, "fit"), cameras_in_rooms(kitchen, 4, "test")
    return ring(name, 40, 0.0), ring(name, 8, 0.3)


def main() -> None:
    """Print the PSNR of each scene on close views, with and without given cameras."""
    from measurements import Bench  # imported here because it imports this module

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="where scenes and measurements are kept")
    parser.add_argument("--scenes", default=",".join(SCENES))
    options = parser.parse_args()
    install()  # splat-transform, which converts scenes to .ply
    bench = Bench(REAL_SCENES, REAL_SCENES.parent / "peers", options.folder)
    known = viewers.APART
    for name in options.scenes.split(","):
        model, (cameras, others) = load(bench.model(name)), near_views(name, bench.model)
        for ratio in (0.1, 0.01):
            results = {preset: simplify(model, ratio=ratio, preset=preset)[0] for preset in PRESETS}
            for label, viewers.APART in (("cameras, all alike", 1e9), ("cameras", known)):
                results[label] = simplify(model, ratio=ratio, cameras=cameras)[0]
            found = compare(model, *results.values(), cameras=others)
            texts = [f"{a} {b.psnr:.2f} dB" for a, b in zip(results, found.models, strict=True)]
            print(f"{name} {ratio:g}: {'; '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
