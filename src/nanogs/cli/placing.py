"""Options for the place of a scene on Earth."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, NamedTuple

from nanogs.cli.options import in_panel
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from nanogs._types import F64
    from nanogs.place import Place

_on_earth = in_panel("Place on Earth (tileset.json)")


class Columns(NamedTuple):
    """The 16 numbers of a 4 x 4 transform in column-major order."""

    numbers: tuple[float, ...]


def parse_columns(text: str) -> Columns:
    """Parse a transform from 16 numbers separated by commas or spaces.

    Raises:
        OptionError: They are not 16 numbers.
    """
    try:
        values = tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        values = ()
    if len(values) != 16:
        raise OptionError(
            "A transform must be 16 numbers separated by commas, column by column, as in"
            f" 1,0,0,0,0,1,0,0,0,0,1,0,10,20,30,1, not {text[:200]!r}."
        )
    return Columns(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Placing:
    """Options for the place of a scene on Earth: position and orientation, or a transform."""

    longitude: Annotated[
        float | None,
        _on_earth(
            "Longitude of the scene's origin, east of Greenwich; west is negative.",
            metavar="DEGREES",
        ),
    ] = None
    latitude: Annotated[
        float | None,
        _on_earth(
            "Latitude of the scene's origin, north of the equator; south is negative.",
            metavar="DEGREES",
        ),
    ] = None
    height: Annotated[
        float | None,
        _on_earth(
            "Height of the scene's origin above the WGS84 ellipsoid, not above sea level.",
            metavar="METRES",
            show_default="0",
        ),
    ] = None
    heading: Annotated[
        float | None,
        _on_earth(
            "Rotation of the scene, clockwise from above; applied last.",
            metavar="DEGREES",
            show_default="0",
        ),
    ] = None
    pitch: Annotated[
        float | None,
        _on_earth(
            "Tilt of the scene, its east side up; applied second.",
            metavar="DEGREES",
            show_default="0",
        ),
    ] = None
    roll: Annotated[
        float | None,
        _on_earth(
            "Tilt of the scene, its north side up; applied first.",
            metavar="DEGREES",
            show_default="0",
        ),
    ] = None
    transform: Annotated[
        Columns | None,
        _on_earth(
            "In place of all these: a matrix of 16 numbers, separated by commas, column by"
            " column, from the tiles' frame, z up, to Earth-centred, Earth-fixed coordinates.",
            parser=parse_columns,
            metavar="NUMBERS",
        ),
    ] = None

    @property
    def place(self) -> "Place | F64 | None":
        """The requested place, an argument of `block_layout_of`; None if no option is given.

        Raises:
            OptionError: Both kinds of options are given, longitude or latitude is missing, or a
                number is out of range.
        """
        given = {
            each.name: value
            for each in fields(self)
            if (value := getattr(self, each.name)) is not None
        }
        if not given:
            return None
        from nanogs.place import Place, from_columns

        columns = given.pop("transform", None)
        if columns is not None:
            if given:
                raise OptionError(
                    f"--transform already gives the whole place; leave out --{min(given)}."
                )
            return from_columns(columns.numbers)
        if missing := {"longitude", "latitude"} - given.keys():
            raise OptionError(
                f"A place on Earth needs --longitude and --latitude; give --{max(missing)} too."
            )
        return Place(**given)
