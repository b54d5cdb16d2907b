"""Coordinate frames: where the axes of a model point, and turning a model from one to another.

A frame is named by where x, y and z point, seen by who looks at the scene: `r`ight or `l`eft, `u`p
or `d`own, `f`orward (away) or `b`ack. Models are trained in `rdf`, the frame of COLMAP and OpenCV;
SPZ is `rub` by its specification, as OpenGL; glTF is `luf`, Unity `ruf`, which is left-handed,
Unreal `fru`, also left-handed, and Blender `rfu`. From `rdf` to `rub` is half a turn about x.

Between two frames axes are swapped and change their signs, which loses no bit of centres, scales
and rotations. Nor of spherical harmonics where no axes are swapped: a basis function then keeps its
value or changes its sign. Otherwise those of a band mix.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from nanogs._types import F32, F64, Array, F
from nanogs.errors import OptionError
from nanogs.sh import basis
from nanogs.splats import Splats, refuse_other

TRAINED, Y_UP = "rdf", "rub"
_ALONG = {"r": (0, 1), "l": (0, -1), "u": (1, 1), "d": (1, -1), "b": (2, 1), "f": (2, -1)}
FRAMES = frozenset(
    "".join(letters)
    for axes in product("rl", "ud", "fb")
    for letters in permutations(axes)
)  # fmt: skip
_NORMALS = ("nx", "ny", "nz")


class Change(NamedTuple):
    """A change of frames: the new axis i is `signs[i]` times the old axis `axes[i]`."""

    axes: tuple[int, int, int]
    signs: tuple[int, int, int]

    @property
    def matrix(self) -> F64:
        """(3, 3): takes centres from here to there."""
        out = np.zeros((3, 3))
        out[range(3), self.axes] = self.signs
        return out

    def of_means(self, means: F) -> F:
        """(N, 3) centres in the new frame."""
        with np.errstate(invalid="ignore"):  # at signalling NaNs
            turned: F = means[:, list(self.axes)] * np.array(self.signs).astype(means.dtype)
        return turned

    @property
    def is_nothing(self) -> bool:
        """Whether both frames are the same."""
        return self == ((0, 1, 2), (1, 1, 1))


def checked_frame(name: str) -> str:
    """The name of a frame in small letters.

    Raises:
        OptionError: It is none.
    """
    if name.lower() not in FRAMES:
        raise OptionError(
            f"A frame says where x, y and z point, like rdf (right, down, forward) or rub (right,"
            f" up, back), not {name!r}."
        )
    return name.lower()


def checked_frames(frames: Sequence[str] | None) -> tuple[str, str] | None:
    """The frames from and to which something is turned, as a caller gives them; None for none.

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
    """Find the change that leads from one frame to another.

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
    """Put a scene into another frame; there and back again is the same, colours aside.

    Args:
        splats: N splats; normals are turned too, other extra columns stay as they are.
        source: The frame they are in, such as `rdf`.
        target: The frame they are to be in.

    Raises:
        OptionError: One of them is no frame.
    """
    refuse_other(splats)
    change = change_between(source, target)
    if change.is_nothing:
        return splats
    axes, signs = list(change.axes), np.array(change.signs)
    # The axes of a rotation are turned with all else; a mirror also changes its sense.
    sense = signs * round(np.linalg.det(change.matrix))
    quats = splats.quats.copy()
    with np.errstate(invalid="ignore"):  # at signalling NaNs
        quats[:, 1:] = splats.quats[:, 1:][:, axes] * sense.astype(quats.dtype)
    return replace(
        splats,
        means=change.of_means(splats.means),
        quats=quats,
        log_scales=splats.log_scales[:, axes].copy(),
        sh=_turned(splats.sh, change),
        extras=dict(splats.extras) | _turned_normals(splats, axes, signs),
    )


def _turned(sh: F32, change: Change) -> F32:
    """(N, K, 3): coefficients whose colours are the old ones, seen from the turned side."""
    matrix = _band_matrix(int(sh.shape[1] ** 0.5) - 1, change)
    signs = np.diag(matrix)
    with np.errstate(invalid="ignore"):  # at signalling NaNs
        if np.array_equal(np.abs(matrix), np.eye(len(matrix))):
            return sh * signs[:, None].astype(np.float32)
        mixed: F32 = np.einsum("jk,nkc->njc", matrix, sh.astype(np.float64)).astype(np.float32)
    return mixed


def _band_matrix(degree: int, change: Change) -> F64:
    """(K, K): the new coefficients of the old ones."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(8 * (degree + 1) ** 2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = basis(directions @ change.matrix, degree)  # the same directions in the old frame
    solved = np.linalg.lstsq(basis(directions, degree), before, rcond=None)[0]
    return np.asarray(solved, np.float64).round(12)


def _turned_normals(splats: Splats, axes: list[int], signs: Array) -> dict[str, Array]:
    """The normals by name, if there are any; zeros, which most files have there, keep their sign.

    So rows are turned alike whatever others are read with them.
    """
    stored = [splats.extras.get(name) for name in _NORMALS]
    if any(column is None or column.dtype.kind != "f" for column in stored):
        return {}
    turned = {}
    for name, axis, sign in zip(_NORMALS, axes, signs, strict=True):
        column = splats.extras[_NORMALS[axis]]
        with np.errstate(invalid="ignore"):  # at signalling NaNs
            turned[name] = np.where(column == 0, column, column * column.dtype.type(sign))
    return turned
