"""Coordinate frames (axis conventions), and conversion of models between them.

A frame is named by the directions of x, y and z as seen by a viewer of the scene: `r`ight or
`l`eft, `u`p or `d`own, `f`orward (away) or `b`ack. Models are trained in `rdf`, the frame of COLMAP
and OpenCV; SPZ is `rub` by its specification, as OpenGL; glTF is `luf`, Unity `ruf`, which is
left-handed, Unreal `fru`, also left-handed, and Blender `rfu`. From `rdf` to `rub` is half a turn
about x.

A change of frames permutes the axes and flips their signs, which keeps every bit of centres, scales
and rotations. It also keeps those of spherical harmonics if no axes are swapped: each basis
function then keeps its value or changes its sign. Otherwise the coefficients of a band mix.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from nanogs._types import F32, F64, Array, F
from nanogs.activations import quaternions
from nanogs.errors import OptionError
from nanogs.pose import normals_of, without_vertical_axis
from nanogs.sh import band_matrix
from nanogs.splats import RenderMode, Splats, refuse_other

TRAINED, Y_UP = "rdf", "rub"
_ALONG = {"r": (0, 1), "l": (0, -1), "u": (1, 1), "d": (1, -1), "b": (2, 1), "f": (2, -1)}
FRAMES = frozenset(
    "".join(letters)
    for axes in product("rl", "ud", "fb")
    for letters in permutations(axes)
)  # fmt: skip


class Change(NamedTuple):
    """A change of frames: the new axis i is `signs[i]` times the old axis `axes[i]`."""

    axes: tuple[int, int, int]
    signs: tuple[int, int, int]

    @property
    def matrix(self) -> F64:
        """(3, 3) float64 matrix that maps centres from the old frame to the new one."""
        out = np.zeros((3, 3))
        out[range(3), self.axes] = self.signs
        return out

    def of_means(self, means: F) -> F:
        """Return (N, 3) centres in the new frame."""
        with np.errstate(invalid="ignore"):  # signalling NaNs would warn
            turned: F = means[:, list(self.axes)] * np.array(self.signs).astype(means.dtype)
        return turned

    @property
    def is_nothing(self) -> bool:
        """Whether both frames are the same, so that nothing changes."""
        return self == ((0, 1, 2), (1, 1, 1))


def checked_frame(name: str) -> str:
    """Return the name of a frame in lower case.

    Raises:
        OptionError: There is no such frame.
    """
    if not isinstance(name, str) or name.lower() not in FRAMES:
        raise OptionError(
            f"A frame says where x, y and z point, like rdf (right, down, forward) or rub (right,"
            f" up, back), not {name!r}."
        )
    return name.lower()


def checked_frames(frames: Sequence[str] | None) -> tuple[str, str] | None:
    """Check a caller's pair of frames, from and to which a model is turned; None stays None.

    Raises:
        OptionError: They are not two, or one of them is no frame.
    """
    if frames is None:
        return None
    several = isinstance(frames, Iterable) and not isinstance(frames, str)
    named = tuple(frames) if several else ()
    if len(named) != 2 or not all(isinstance(name, str) for name in named):
        raise OptionError(
            "`frame` must be the frames from and to which the model is turned, such as"
            f' ("rdf", "rub"), not {frames!r}.'
        )
    return checked_frame(named[0]), checked_frame(named[1])


def change_between(source: str, target: str) -> Change:
    """Compute the change of axes from one frame to another.

    Raises:
        OptionError: One of them is no frame.
    """
    own = {_ALONG[letter][0]: i for i, letter in enumerate(checked_frame(source))}
    axes, signs = [], []
    for letter in checked_frame(target):
        along, sign = _ALONG[letter]
        axes.append(own[along])
        signs.append(sign * _ALONG[source.lower()[own[along]]][1])
    return Change((axes[0], axes[1], axes[2]), (signs[0], signs[1], signs[2]))


def change_frame(splats: Splats, source: str, target: str) -> Splats:
    """Convert a scene to another frame; converting back restores every bit except of colours.

    In models of 2DGS the third axis of a splat is its normal and stays the third. Where another
    axis would take its place, as from y up to z up, rotations are restored up to rounding.

    Args:
        splats: N splats; normals are turned too, other extra columns are unchanged.
        source: The frame of the splats, such as `rdf`.
        target: The frame to convert them to.

    Raises:
        OptionError: One of them is no frame.
    """
    refuse_other(splats)
    change = change_between(source, target)
    if change.is_nothing:
        return splats
    axes, signs = list(change.axes), np.array(change.signs)
    # The axis of a rotation is turned like any vector; a mirror also reverses its sense.
    sense = signs * round(np.linalg.det(change.matrix))
    quats = splats.quats.copy()
    with np.errstate(invalid="ignore"):  # signalling NaNs would warn
        quats[:, 1:] = splats.quats[:, 1:][:, axes] * sense.astype(quats.dtype)
    log_scales = splats.log_scales[:, axes].copy()
    if splats.render_mode is RenderMode.SURFEL and axes[2] != 2:
        quats, log_scales = _in_old_order(quats, change), splats.log_scales.copy()
    return replace(
        splats,
        means=change.of_means(splats.means),
        quats=quats,
        log_scales=log_scales,
        sh=_turned(splats.sh, change),
        extras=dict(splats.extras) | _turned_normals(splats, axes, signs),
        comments=comments_in(change, splats.comments),
    )


def comments_in(change: Change, comments: Sequence[str]) -> tuple[str, ...]:
    """Return the comments of a model in another frame, without one on its vertical axis."""
    return tuple(comments) if change.is_nothing else without_vertical_axis(comments)


def turned(splats: Splats, frames: tuple[str, str] | None) -> Splats:
    """Convert a scene from the first of two frames to the second, if there are any."""
    return change_frame(splats, *frames) if frames else splats


def back(frames: tuple[str, str] | None) -> tuple[str, str] | None:
    """Return the frames that a scene is turned back from and to; None if it is not turned."""
    return frames and (frames[1], frames[0])


def _in_old_order(quats: F32, change: Change) -> F32:
    """Return (N, 4) rotations, wxyz, in the new frame for splats whose axes keep their order.

    Args:
        quats: (N, 4) rotations in the new frame of splats whose axes are permuted as the frame's.
        change: The change of frames. Of a mirror, the sign of the third axis is left out.
    """
    order = change.matrix
    order[:, 2] *= round(np.linalg.det(order))
    w0, x0, y0, z0 = quaternions(order[None])[0]
    whole = np.where(quats.any(axis=1, keepdims=True), quats, (1.0, 0.0, 0.0, 0.0))
    with np.errstate(invalid="ignore"):  # NaN and infinite rotations become NaN
        w, x, y, z = whole.astype(np.float64).T
        product = [
            w * w0 - x * x0 - y * y0 - z * z0,
            w * x0 + x * w0 + y * z0 - z * y0,
            w * y0 - x * z0 + y * w0 + z * x0,
            w * z0 + x * y0 - y * x0 + z * w0,
        ]
        return np.stack(product, axis=1).astype(np.float32)


def _turned(sh: F32, change: Change) -> F32:
    """Return (N, K, 3) coefficients in the new frame, for the same colours from each side."""
    matrix = band_matrix(change.matrix, int(sh.shape[1] ** 0.5) - 1)
    signs = np.diag(matrix)
    with np.errstate(invalid="ignore"):  # signalling NaNs would warn
        if np.array_equal(np.abs(matrix), np.eye(len(matrix))):
            return sh * signs[:, None].astype(np.float32)
        mixed: F32 = np.einsum("jk,nkc->njc", matrix, sh.astype(np.float64)).astype(np.float32)
    return mixed


def _turned_normals(splats: Splats, axes: list[int], signs: Array) -> dict[str, Array]:
    """Return the turned normal columns by name, if the model has them.

    Zeros, which most files have there, keep their sign, so that the result for a row does not
    depend on the rows it is read with.
    """
    stored = normals_of(splats.extras)
    columns, turned = list(stored.values()), {}
    for place, name in enumerate(stored):
        column, sign = columns[axes[place]], signs[place]
        with np.errstate(invalid="ignore"):  # signalling NaNs would warn
            turned[name] = np.where(column == 0, column, column * column.dtype.type(sign))
    return turned
