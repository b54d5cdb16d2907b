"""Node transforms of a glTF scene, and applying them to splats.

A node's transform has to decompose into translation, rotation and positive scales, as the extension
demands, or it is refused: others mirror or shear the splats. Scales that differ between axes give
splats new principal axes, those of their stretched covariance. Spherical harmonics are rotated with
the splats.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from nanogs._types import F64
from nanogs.activations import rotations
from nanogs.errors import FormatError
from nanogs.io.gltf.document import Document, JsonObject
from nanogs.pose import Pose

EXTENSION = "KHR_gaussian_splatting"
# glTF is y-up, 3DGS files are y-down by convention: half a turn about z converts between them.
HALF_TURN = (0.0, 0.0, 1.0, 0.0)  # xyzw
TO_PLY = np.diag([-1.0, -1.0, 1.0, 1.0])  # the same, and its own inverse
# From y up to z up, as in 3D Tiles; the transpose is the inverse.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_IDENTITY = tuple(np.eye(4).ravel().tolist())
_MAX_PRIMITIVES = 4096
_CLOSE = 1e-4  # tolerance for rounding in single precision, accumulated over a few nodes


@dataclass(frozen=True, slots=True)
class PlacedPrimitive:
    """A primitive of splats, its node, and its transform to the frame of `.ply` files."""

    primitive: JsonObject
    node: JsonObject
    pose: Pose


def placed_splats(document: Document, above: F64) -> tuple[list[PlacedPrimitive], int]:
    """Return the splat primitives of the scene, and the number of other primitives.

    Args:
        document: The file.
        above: (4, 4) float64: transform of the whole scene, applied after its node transforms.

    Raises:
        FormatError: There is no splat primitive, the nodes do not form a tree, or a transform
            mirrors or shears.
    """
    found, others = [], 0
    for node, matrix in _nodes(document.root, above):
        if "mesh" not in node.data:
            continue
        mesh = document.root.at("meshes", node.integer("mesh"))
        for number in range(len(mesh.items("primitives"))):
            primitive = mesh.at("primitives", number)
            if EXTENSION not in primitive.part("extensions").data:
                others += 1
                continue
            found.append(PlacedPrimitive(primitive, node, pose_of(matrix, node.error)))
            if len(found) > _MAX_PRIMITIVES:
                raise node.error(f"is one of too many: nanogs reads {_MAX_PRIMITIVES} primitives")
    if not found:
        raise _without_splats(document)
    return found, others


def _without_splats(document: Document) -> FormatError:
    used = [name for name in document.root.items("extensionsUsed") if isinstance(name, str)]
    other = [name for name in used if "splat" in name and name != EXTENSION]
    if other:
        what = f"stores splats with {other[0][:80]!a}, which nanogs does not read; export it with"
        return FormatError(f"{document.path} {what} {EXTENSION}.")
    return FormatError(
        f"{document.path} holds no primitive with {EXTENSION} in its scene, so it is a mesh or"
        " point cloud; export the splats."
    )


def _nodes(root: JsonObject, above: F64) -> Iterator[tuple[JsonObject, F64]]:
    """Yield the nodes of the scene with their global matrices, parents first."""
    if not root.items("scenes"):
        raise root.error("has no scene")
    scene = root.at("scenes", root.integer("scene", 0))
    waiting = [(index, above) for index in reversed(scene.indices("nodes"))]
    seen: set[int] = set()
    while waiting:
        index, above = waiting.pop()
        node = root.at("nodes", index)
        if index in seen:
            raise node.error("has two parents or is its own parent, but nodes must form a tree")
        seen.add(index)
        with np.errstate(all="ignore"):  # overflow is refused by `pose_of`
            matrix = above @ _local(node)
        yield node, matrix
        waiting += [(child, matrix) for child in reversed(node.indices("children"))]


def _local(node: JsonObject) -> F64:
    """Return the (4, 4) local matrix of a node."""
    if "matrix" in node.data:
        return node.numbers("matrix", _IDENTITY).reshape(4, 4).T
    x, y, z, w = node.numbers("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = np.eye(4)
    matrix[:3, :3] = rotations(np.array([[w, x, y, z]]))[0] * node.numbers("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.numbers("translation", (0.0, 0.0, 0.0))
    return matrix


def pose_of(matrix: F64, error: Callable[[str], FormatError]) -> Pose:
    """Decompose a transform, combined with the turn from y up to the frame of `.ply` files.

    Args:
        matrix: (4, 4) float64, a transform to a frame with y up.
        error: Makes the error to raise from a description of the problem.

    Raises:
        FormatError: It mirrors, flattens or shears, or its last row is not 0, 0, 0, 1.
    """
    if np.isfinite(matrix).all() and np.abs(matrix[3] - (0, 0, 0, 1)).max() > _CLOSE:
        raise error(
            "has a transform whose last row is not 0, 0, 0, 1, perhaps because its rows were"
            " written as columns"
        )
    with np.errstate(all="ignore"):
        matrix = TO_PLY @ matrix
        linear = matrix[:3, :3]
        same = np.cbrt(np.linalg.det(linear))
        scale = np.full(3, same)
        if _skew(linear / scale) > _CLOSE:
            scale = np.linalg.norm(linear, axis=0)
        rotation = linear / scale
    if not (np.isfinite(matrix).all() and np.isfinite(scale).all() and same > 0):
        raise error("mirrors or flattens its splats, or is too large")
    if not _skew(rotation) <= _CLOSE:  # nor NaN
        raise error("shears its splats; apply its transform first")
    left, _, right = np.linalg.svd(rotation)
    rotation = left @ right
    whole = rotation.round()
    if np.abs(rotation - whole).max() < 1e-12:
        rotation = whole
    return Pose(rotation, np.where(np.abs(scale - 1) < 1e-12, 1, scale), matrix[:3, 3])


def put_placed(out: dict[str, Any], pose: Pose, means: F64, quats: F64, log_scales: F64) -> None:
    """Fill rows with transformed geometry, and rotate their SH coefficients in place."""
    if not pose.is_identity():
        means = pose.means(means)
        quats, log_scales = pose.shapes(quats, log_scales)
        out["sh"][:] = pose.harmonics(out["sh"])
    out["means"][:], out["quats"][:], out["log_scales"][:] = means, quats, log_scales


def _skew(rotation: F64) -> float:
    """Return the largest deviation of the columns from being orthonormal."""
    return float(np.abs(rotation.T @ rotation - np.eye(3)).max())
