"""Where on Earth a scene is: longitude, latitude and height, and how it is turned there.

The frames are those of 3D Tiles and CesiumJS. Earth-centred, Earth-fixed coordinates, metres: x
goes through latitude 0, longitude 0, z through the north pole. The ellipsoid is that of WGS84,
which heights are above; it is up to some 100 m from the level of the sea. At a place, x is east, y
north and z up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from nanogs._types import F64
from nanogs.errors import OptionError
from nanogs.ranges import is_number, value_text

# WGS84: half the axis through the equator, metres, and the flattening (NGA.STND.0036, table 3.1).
RADIUS = 6_378_137.0
_FLATTENING = 1 / 298.257223563
_SQUARED = _FLATTENING * (2 - _FLATTENING)  # of the eccentricity
_POLAR = RADIUS * (1 - _FLATTENING)  # half the axis through the poles
_ROUNDS = 5  # of `_geodetic`; three are enough near Earth
# Metres: what is above is a slip, and squares of what is below are finite.
_FARTHEST = 1e12
_FLAT = 1e-6  # of a box whose edges have length 1, the volume below which it is flat
# Of the matrix of a `Place`, in which numbers of 1 are rounded.
_ROUNDED = 1e-9
_HIGH = 1e5  # metres above or below the ellipsoid: no scene is there


@dataclass(frozen=True, slots=True)
class Place:
    """A place on Earth, and how a scene is turned there.

    Angles are degrees, and turn the scene about its own origin as CesiumJS has it: the roll first,
    about the axis that points east, its north side up; then the pitch, about the one that points
    north, its east side up; then the heading, about the one that points up, clockwise as seen from
    above, so that by 90 what was north is east.

    Attributes:
        longitude: Of the scene's origin, east of Greenwich, -180 to 180.
        latitude: Of the scene's origin, north of the equator, -90 to 90; geodetic, as on maps.
        height: Of the scene's origin above the ellipsoid of WGS84, metres.
        heading: As above.
        pitch: As above.
        roll: As above.
    """

    longitude: float
    latitude: float
    height: float = 0.0
    heading: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is nowhere.

        Raises:
            OptionError: An angle is out of its range, or a number is not finite or far too large.
        """
        limits = {"longitude": 180.0, "latitude": 90.0, "height": _FARTHEST}
        for field in fields(self):
            value, limit = getattr(self, field.name), limits.get(field.name, math.inf)
            if not (is_number(value) and math.isfinite(value) and abs(value) <= limit):
                raise OptionError(_out_of_range(field.name, value, limit))

    def matrix(self) -> F64:
        """The transform from the scene's frame, z up, to Earth-centred, Earth-fixed coordinates.

        It is T · Rz(-heading) · Ry(-pitch) · Rx(roll) with T from east, north and up, as
        `Transforms.headingPitchRollToFixedFrame` of CesiumJS has it (its `Quaternion.
        fromHeadingPitchRoll` states the signs). T's axes and origin are those of EPSG method 9837,
        geographic to topocentric coordinates (IOGP 373-7-2).

        Returns:
            (4, 4) float64, rotation and shift; columns are multiplied from the right.
        """
        matrix = np.eye(4)
        axes, matrix[:3, 3] = _tangent(self.longitude, self.latitude, self.height)
        heading, pitch, roll = np.deg2rad([self.heading, self.pitch, self.roll])
        matrix[:3, :3] = axes @ _about(2, -heading) @ _about(1, -pitch) @ _about(0, roll)
        return matrix

    @classmethod
    def of(cls, matrix: F64) -> Self | None:
        """The place of a (4, 4) transform; None where it is not one of the surface of Earth.

        Its origin is farther than 100 km from the ellipsoid then, or it scales or mirrors.
        """
        turn = matrix[:3, :3]
        rigid = np.abs(turn.T @ turn - np.eye(3)).max() < _ROUNDED and np.linalg.det(turn) > 0
        longitude, latitude, height = _geodetic(matrix[:3, 3])
        if not rigid or abs(height) > _HIGH:
            return None
        axes, _ = _tangent(longitude, latitude, height)
        r = axes.T @ turn
        level = math.hypot(r[0, 0], r[1, 0])  # the cosine of the pitch
        roll = 0.0
        if level > _ROUNDED:
            heading, roll = math.atan2(-r[1, 0], r[0, 0]), math.atan2(r[2, 1], r[2, 2])
        else:  # straight up or down, heading and roll are one: all is said to be heading
            heading = math.atan2(r[0, 1], r[1, 1])
        angles = np.rad2deg([heading, math.atan2(r[2, 0], level), roll]).tolist()
        return cls(longitude, latitude, height, *angles)


def transform_of(place: Place | Sequence[Sequence[float]] | F64) -> F64:
    """The transform that puts a scene into its place.

    Args:
        place: The place; or the transform itself, (4, 4), from the frame of 3D Tiles, z up, with
            the shift in its last column.

    Returns:
        (4, 4) float64.

    Raises:
        OptionError: It is no transform of that size, not finite or far too large, not affine (its
            last row is not 0, 0, 0, 1), or it mirrors or flattens what it is applied to.
    """
    if isinstance(place, Place):
        return place.matrix()
    try:
        matrix = np.array(place, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise OptionError("A place is a `nanogs.Place`, or a transform of four rows of four.")
    if not (np.abs(matrix) <= _FARTHEST).all():  # NaN too
        raise OptionError(f"A transform has finite numbers of at most {_FARTHEST:g}.")
    if (matrix[3] != [0, 0, 0, 1]).any():
        raise OptionError(
            "A transform must be affine, and its last row 0, 0, 0, 1: of the 16 numbers, column"
            " after column, the 4th, 8th and 12th are 0 and the 16th is 1."
        )
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if not lengths.all() or np.linalg.det(matrix[:3, :3] / lengths) < _FLAT:
        raise OptionError("The transform mirrors or flattens the scene; give one that does not.")
    return matrix


def from_columns(values: Sequence[float]) -> F64:
    """The (4, 4) float64 transform of 16 numbers, column after column, as 3D Tiles have them."""
    return np.array(values, np.float64).reshape(4, 4).T


def columns(matrix: F64) -> tuple[float, ...]:
    """The 16 numbers of a (4, 4) transform, column after column, as 3D Tiles have them."""
    return tuple(matrix.T.ravel().tolist())


def text_of(matrix: F64) -> str:
    """Text of the fields of a `Place`, or of the matrix's 16 numbers, column after column."""
    place = Place.of(matrix)
    if place is None:
        texts = (repr(value + 0.0).removesuffix(".0") for value in columns(matrix))
        return f"transform {','.join(texts)}"
    # A tenth of a millimetre, and as much an angle is of it.
    digits = {"longitude": 9, "latitude": 9, "height": 4}
    named = ((each.name, getattr(place, each.name)) for each in fields(place))
    rounded = ((name, round(value, digits.get(name, 7)) + 0.0) for name, value in named)
    return ", ".join(f"{name} {f'{value:.9f}'.rstrip('0').rstrip('.')}" for name, value in rounded)


def _out_of_range(name: str, value: object, limit: float) -> str:
    """Say that a number of a place cannot be meant."""
    unit = "metres" if name == "height" else "degrees"
    if math.isinf(limit):
        return f"The {name} of a place is a finite number of {unit}, not {value_text(value)}."
    return f"The {name} of a place is -{limit:g} to {limit:g} {unit}, not {value_text(value)}."


def _about(axis: int, angle: float) -> F64:
    """(3, 3): a turn by an angle, radians, counterclockwise about an axis of the frame."""
    turn = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn[a, a] = turn[b, b] = math.cos(angle)
    turn[b, a] = math.sin(angle)
    turn[a, b] = -turn[b, a]
    return turn


def _tangent(longitude: float, latitude: float, height: float) -> tuple[F64, F64]:
    """East, north and up, the columns of a (3, 3), and the (3,) origin of a place, metres."""
    east_of, north_of = math.radians(longitude), math.radians(latitude)
    sin_lon, cos_lon = math.sin(east_of), math.cos(east_of)
    sin_lat, cos_lat = math.sin(north_of), math.cos(north_of)
    up = np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
    east = np.array([-sin_lon, cos_lon, 0.0])
    north = np.array([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])
    # From the axis of Earth to the ellipsoid, along the normal.
    reach = RADIUS / math.sqrt(1 - _SQUARED * sin_lat**2)
    origin = up * [reach + height, reach + height, reach * (1 - _SQUARED) + height]
    return np.column_stack([east, north, up]), origin


def _geodetic(point: F64) -> tuple[float, float, float]:
    """Longitude and latitude, degrees, and height, metres, of an Earth-centred point.

    By the iteration of Bowring, "Transformation from spatial to geographical coordinates", Survey
    Review 23 (1976), over the reduced latitude.
    """
    x, y, z = point.tolist()
    away = math.hypot(x, y)
    reduced = math.atan2(z, (1 - _FLATTENING) * away)
    for _ in range(_ROUNDS):
        latitude = math.atan2(
            z + _SQUARED / (1 - _SQUARED) * _POLAR * math.sin(reduced) ** 3,
            away - _SQUARED * RADIUS * math.cos(reduced) ** 3,
        )
        reduced = math.atan2((1 - _FLATTENING) * math.sin(latitude), math.cos(latitude))
    sin = math.sin(latitude)
    height = away * math.cos(latitude) + z * sin - RADIUS * math.sqrt(1 - _SQUARED * sin**2)
    return math.degrees(math.atan2(y, x)), math.degrees(latitude), height
