"""A kernel that calls all vector functions, to test whether they compile and run."""

import numpy as np

from nanogs._types import F32, F64, I32, U32
from nanogs.kernels import blending, blocks, closest, gradients, lanes
from nanogs.kernels.policy import kernel


@kernel
def _call_all(
    points: F64,
    boxes: F64,
    keys: I32,
    shapes: F32,
    marks: U32,
    transmittances: F32,
    planes: F32,
    sums: F32,
) -> int:
    lanes.distance_keys(points, 0.0, 0.0, 0.0, keys, 0)
    lanes.box_keys(points, boxes, 0, keys)
    mask = lanes.within(keys, 0, keys)
    lanes.insert(keys, keys, 16, 1)
    blocks.prefetch(shapes, 0, 0)
    mask &= blocks.mark_blocks(shapes, 0, marks) & blocks.open_blocks(transmittances)
    blending.blend_block(marks[0], 0, shapes, sums[0], transmittances, sums[0], planes)
    blending.add_block(marks[0], 0, sums[0], sums[0], 0, planes)
    blending.probe_block(marks[0], 0, sums[0], planes, 0, sums)
    sums[0, 0, 0] = blending.total(sums, 0, 0)
    gradients.gradient_blocks(
        1, 0, shapes, sums[0], transmittances, planes, planes, transmittances, sums[0], 1
    )
    closest.closest(transmittances, sums[0], sums[0, 0], 1, transmittances, transmittances, keys)
    return lanes.lowest_bit(mask | 1)


def run() -> None:
    """Compile the kernel, or load it from the cache, and call it."""
    shapes, sums = np.zeros((32, 8), np.float32), np.zeros((4, 32, 32), np.float32)
    transmittances, planes = np.ones((16, 16), np.float32), np.zeros((4, 16, 16), np.float32)
    boxes, marks = np.zeros((1, 6)), np.zeros(16, np.uint32)
    _call_all(
        np.zeros(48), boxes, np.zeros(64, np.int32), shapes, marks, transmittances, planes, sums
    )
