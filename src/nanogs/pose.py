"""Moving, turning and scaling splats, whose spherical harmonics turn with them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nanogs._types import F32, F64, Array
from nanogs.activations import quaternions, rotation_about, rotations
from nanogs.errors import OptionError
from nanogs.findings import Finding
from nanogs.ranges import is_number
from nanogs.sh import band_matrix
from nanogs.splats import Splats

_TOO_FAR = "{:splat is|splats are} moved to infinity; move or scale the model less."
_ROUNDING = 1e-12  # entries of rotations this close to a whole number are one: quarter turns


@dataclass(frozen=True, slots=True)
class Pose:
    """A transform without shear: x -> rotation (scale · x) + shift.

    Attributes:
        rotation: (3, 3) float64, orthonormal with determinant 1.
        scale: (3,) float64, above 0; three equal numbers if the scaling is uniform.
        shift: (3,) float64, scene units.
    """

    rotation: F64
    scale: F64
    shift: F64

    def is_identity(self) -> bool:
        """Return whether the transform changes nothing."""
        same = np.array_equal(self.rotation, np.eye(3)) and (self.scale == 1).all()
        return bool(same and not self.shift.any())

    def means(self, means: F64) -> F64:
        """Transform (R, 3) float64 centres."""
        turned: F64 = self.scale * means @ self.rotation.T + self.shift
        return turned

    def shapes(self, quats: F64, log_scales: F64) -> tuple[F64, F64]:
        """Transform the rotations and scales of splats.

        If the scaling is not uniform, the axes of the results are sorted, the longest first.

        Args:
            quats: (R, 4) wxyz, not necessarily of unit length; zero is the identity.
            log_scales: (R, 3).

        Returns:
            Both for the transformed splats; NaN for splats with a NaN or an infinite value where
            the scaling is not uniform.
        """
        quats = np.where(quats.any(axis=1, keepdims=True), quats, (1.0, 0.0, 0.0, 0.0))
        if (self.scale == self.scale[0]).all():
            return self._turned(quats), log_scales + np.log(self.scale[0])
        unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        stretched = self.rotation * self.scale @ (rotations(unit) * np.exp(log_scales)[:, None])
        whole = np.isfinite(stretched).all(axis=(1, 2))
        # The SVD gives the axes and their lengths without squaring them, as a covariance would.
        turned, lengths, _ = np.linalg.svd(np.where(whole[:, None, None], stretched, np.eye(3)))
        turned[:, :, 2] *= np.linalg.det(turned)[:, None]
        return (
            np.where(whole[:, None], quaternions(turned), np.nan),
            np.where(whole[:, None], np.log(lengths), np.nan),
        )

    def _turned(self, quats: F64) -> F64:
        """Apply the rotation to (R, 4) wxyz rotations of splats; the result is float64."""
        w, *v = quaternions(self.rotation[None])[0]
        axis = np.array(v)
        real, imaginary = quats[:, :1], quats[:, 1:]
        return np.concatenate(
            [
                w * real - imaginary @ axis[:, None],
                w * imaginary + real * axis + np.cross(axis, imaginary),
            ],
            axis=1,
        )

    def harmonics(self, sh: F32) -> F64:
        """Rotate (R, K, 3) SH coefficients, so that colours turn with the splats."""
        matrix = band_matrix(self.rotation, int(sh.shape[1] ** 0.5) - 1)
        result: F64 = np.einsum("jk,rkc->rjc", matrix, sh.astype(np.float64))
        return result

    def applied(self, splats: Splats) -> Splats:
        """Return N transformed splats; normals are turned, other extra columns are unchanged.

        A note says how many get an infinite centre.
        """
        if self.is_identity():
            return splats
        turns = not np.array_equal(self.rotation, np.eye(3))
        with np.errstate(invalid="ignore", over="ignore"):  # rows with NaN and infinite values
            quats, log_scales = self.shapes(
                splats.quats.astype(np.float64), splats.log_scales.astype(np.float64)
            )
            means = self.means(splats.means.astype(np.float64)).astype(splats.means.dtype)
            lost = np.isinf(means).any(axis=1) & np.isfinite(splats.means).all(axis=1)
            said = [Finding(_TOO_FAR, int(lost.sum()))] if lost.any() else []
            return replace(
                splats,
                means=means,
                quats=quats.astype(np.float32) if turns else splats.quats,
                log_scales=log_scales.astype(np.float32),
                sh=self.harmonics(splats.sh).astype(np.float32) if turns else splats.sh,
                extras=dict(splats.extras) | (self._normals(splats.extras) if turns else {}),
                comments=self.comments(splats.comments),
                notes=[*splats.notes, *said],
            )

    def comments(self, comments: Sequence[str]) -> tuple[str, ...]:
        """Return the comments of a transformed model, without one on its vertical axis."""
        if np.array_equal(self.rotation, np.eye(3)):
            return tuple(comments)
        return without_vertical_axis(comments)

    def _normals(self, extras: Mapping[str, Array]) -> dict[str, Array]:
        """Return turned columns of normals; see `normals_of`."""
        if not (given := normals_of(extras)):
            return {}
        turned = np.stack(list(given.values()), axis=1).astype(np.float64) @ self.rotation.T
        return {
            name: turned[:, axis].astype(column.dtype)
            for axis, (name, column) in enumerate(given.items())
        }


def pose_of_options(
    scale: float, rotate: Sequence[float], translate: Sequence[float]
) -> Pose | None:
    """Make a pose with a uniform scale from options; None if they change nothing.

    Args:
        scale: Factor, above 0.
        rotate: Three angles in degrees: the turn about x is first, then those about y and about z,
            each counterclockwise seen from the tip of the axis.
        translate: (3,) shift, scene units after scaling.

    Raises:
        OptionError: An option is of another type or out of range.
    """
    if not (is_number(scale) and np.isfinite(scale) and scale > 0):
        raise OptionError(f"The scale must be a number above 0, not {scale!r}.")
    turn = np.eye(3)
    for axis, angle in enumerate(np.radians(_three("rotation", rotate))):
        turn = rotation_about(axis, angle) @ turn
    whole = turn.round()
    turn = np.where(np.abs(turn - whole) < _ROUNDING, whole, turn)
    pose = Pose(turn, np.full(3, float(scale)), _three("translation", translate))
    return None if pose.is_identity() else pose


def normals_of(extras: Mapping[str, Array]) -> dict[str, Array]:
    """Return the three columns of normals; none if one of them is missing or no float."""
    found = {name: extras[name] for name in ("nx", "ny", "nz") if name in extras}
    whole = len(found) == 3 and all(column.dtype.kind == "f" for column in found.values())
    return found if whole else {}


def without_vertical_axis(comments: Iterable[str]) -> tuple[str, ...]:
    """Return the comments of a turned model, without one on its vertical axis."""
    return tuple(
        comment for comment in comments if not comment.strip().lower().startswith("vertical axis")
    )


def _three(what: str, given: Iterable[float]) -> F64:
    values: tuple[Any, ...] = tuple(given) if isinstance(given, Iterable) else ()
    if len(values) != 3 or not all(is_number(value) and np.isfinite(value) for value in values):
        raise OptionError(f"The {what} must be three finite numbers, x, y and z, not {given!r}.")
    return np.array(values, np.float64)
