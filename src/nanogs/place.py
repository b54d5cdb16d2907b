"""Geographic placement of a scene: longitude, latitude, height and orientation.

The frames are those of 3D Tiles and CesiumJS. In Earth-centred, Earth-fixed coordinates, metres, x
points to latitude 0, longitude 0, and z to the north pole. Heights are above the WGS84 ellipsoid,
which is up to some 100 m from sea level. In the local frame of a place, x is east, y north and z
up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from nanogs._types import F64
from nanogs.activations import rotation_about
from nanogs.errors import OptionError
from nanogs.formatting import exact_text
from nanogs.ranges import is_number, value_text

# WGS84: semi-major axis, metres, and flattening (NGA.STND.0036, table 3.1).
RADIUS = 6_378_137.0
_FLATTENING = 1 / 298.257223563
_SQUARED = _FLATTENING * (2 - _FLATTENING)  # squared eccentricity
_POLAR = RADIUS * (1 - _FLATTENING)  # semi-minor axis, metres
_ROUNDS = 5  # iterations of `_geodetic`; three are enough near Earth
# Largest number of a transform, metres: more is a mistake, and squares of less are finite.
_FARTHEST = 1e12
_FLAT = 1e-6  # volume of the box of unit axes below which a transform flattens
# Tolerance for rounding errors in a rotation matrix.
_ROUNDED = 1e-9
_HIGH = 1e5  # largest distance of a scene from the ellipsoid, metres


@dataclass(frozen=True, slots=True)
class Place:
    """The position and orientation of a scene on Earth.

    Angles are in degrees and rotate the scene about its own origin, in the convention of CesiumJS:
    first the roll about the axis that points east, which lifts the north side; then the pitch about
    the axis that points north, which lifts the east side; then the heading about the axis that
    points up, clockwise as seen from above, so that 90 turns north to east.

    Attributes:
        longitude: Longitude of the scene's origin, east of Greenwich, -180 to 180.
        latitude: Latitude of the scene's origin, north of the equator, -90 to 90; geodetic, as on
            maps.
        height: Height of the scene's origin above the WGS84 ellipsoid, metres.
        heading: Rotation about the axis that points up, degrees, applied last.
        pitch: Rotation about the axis that points north, degrees, applied second.
        roll: Rotation about the axis that points east, degrees, applied first.
    """

    longitude: float
    latitude: float
    height: float = 0.0
    heading: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        """Check the ranges of the fields.

        Raises:
            OptionError: An angle is out of its range, or a number is not finite or far too large.
        """
        limits = {"longitude": 180.0, "latitude": 90.0, "height": _FARTHEST}
        for field in fields(self):
            value, limit = getattr(self, field.name), limits.get(field.name, math.inf)
            if not (is_number(value) and -math.inf < value < math.inf and abs(value) <= limit):
                raise OptionError(_out_of_range(field.name, value, limit))

    def matrix(self) -> F64:
        """Compute the transform from the scene's frame, z up, to Earth-centred, Earth-fixed axes.

        It is T · Rz(-heading) · Ry(-pitch) · Rx(roll), where T maps east, north and up, like
        `Transforms.headingPitchRollToFixedFrame` of CesiumJS (its `Quaternion.
        fromHeadingPitchRoll` states the signs). T's axes and origin are those of EPSG method 9837,
        geographic to topocentric coordinates (IOGP 373-7-2).

        Returns:
            (4, 4) float64, rotation and translation, to be multiplied by column vectors.
        """
        matrix = np.eye(4)
        axes, matrix[:3, 3] = _tangent(self.longitude, self.latitude, self.height)
        heading, pitch, roll = np.deg2rad([self.heading, self.pitch, self.roll])
        level = axes @ rotation_about(2, -heading)
        matrix[:3, :3] = level @ rotation_about(1, -pitch) @ rotation_about(0, roll)
        return matrix

    @classmethod
    def of(cls, matrix: F64) -> Self | None:
        """Make the place of a (4, 4) transform; None if there is none.

        There is none if the origin is farther than 100 km from the ellipsoid, or if the transform
        scales or mirrors.
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
        else:  # gimbal lock: heading and roll turn about one axis, and all is given to the heading
            heading = math.atan2(r[0, 1], r[1, 1])
        angles = np.rad2deg([heading, math.atan2(r[2, 0], level), roll]).tolist()
        return cls(longitude, latitude, height, *angles)


def transform_of(place: Place | Sequence[Sequence[float]] | F64) -> F64:
    """Return the transform from a scene's frame to Earth-centred, Earth-fixed coordinates.

    Args:
        place: The place; or the transform itself, (4, 4), from the frame of 3D Tiles, z up, with
            the translation in its last column.

    Returns:
        (4, 4) float64.

    Raises:
        OptionError: It is no transform of that size, not finite or far too large, not affine (its
            last row is not 0, 0, 0, 1), or it mirrors or flattens the scene.
    """
    if isinstance(place, Place):
        return place.matrix()
    try:
        matrix = np.array(place, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise OptionError(
            "A place must be a `nanogs.Place`, or a transform of four rows of four numbers."
        )
    if not (np.abs(matrix) <= _FARTHEST).all():  # NaN too
        raise OptionError(f"The numbers of a transform must be finite and at most {_FARTHEST:g}.")
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
    """Make a (4, 4) float64 transform of 16 numbers in column-major order, as in 3D Tiles."""
    return np.array(values, np.float64).reshape(4, 4).T


def columns(matrix: F64) -> tuple[float, ...]:
    """Return the 16 numbers of a (4, 4) transform in column-major order, as in 3D Tiles."""
    return tuple(matrix.T.ravel().tolist())


def text_of(matrix: F64) -> str:
    """Describe a (4, 4) transform by the fields of its `Place`, or else by its 16 numbers.

    The numbers are in column-major order.
    """
    place = Place.of(matrix)
    if place is None:
        return f"transform {','.join(exact_text(value + 0.0) for value in columns(matrix))}"
    # Digits for a tenth of a millimetre on Earth.
    digits = {"longitude": 9, "latitude": 9, "height": 4}
    named = ((each.name, getattr(place, each.name)) for each in fields(place))
    rounded = ((name, round(value, digits.get(name, 7)) + 0.0) for name, value in named)
    return ", ".join(f"{name} {f'{value:.9f}'.rstrip('0').rstrip('.')}" for name, value in rounded)


def _out_of_range(name: str, value: object, limit: float) -> str:
    """Return the message for a field of a place that is out of range."""
    unit = "metres" if name == "height" else "degrees"
    if math.isinf(limit):
        return f"The {name} of a place must be a finite number of {unit}, not {value_text(value)}."
    return (
        f"The {name} of a place must be from -{limit:g} to {limit:g} {unit}, not"
        f" {value_text(value)}."
    )


def _tangent(longitude: float, latitude: float, height: float) -> tuple[F64, F64]:
    """Return a (3, 3) with columns east, north and up, and the (3,) origin of a place, metres."""
    east_of, north_of = math.radians(longitude), math.radians(latitude)
    sin_lon, cos_lon = math.sin(east_of), math.cos(east_of)
    sin_lat, cos_lat = math.sin(north_of), math.cos(north_of)
    up = np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
    east = np.array([-sin_lon, cos_lon, 0.0])
    north = np.array([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])
    # Radius of curvature in the prime vertical: from Earth's axis to the ellipsoid, on the normal.
    reach = RADIUS / math.sqrt(1 - _SQUARED * sin_lat**2)
    origin = up * [reach + height, reach + height, reach * (1 - _SQUARED) + height]
    return np.column_stack([east, north, up]), origin


def _geodetic(point: F64) -> tuple[float, float, float]:
    """Compute longitude and latitude, degrees, and height, metres, of an Earth-centred point.

    Uses the iteration over the reduced latitude of Bowring, "Transformation from spatial to
    geographical coordinates", Survey Review 23 (1976).
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
