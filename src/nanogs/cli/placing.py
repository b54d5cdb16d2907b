"""Options of where on Earth a scene is."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, NamedTuple

from nanogs.cli.options import in_panel
from nanogs.errors import OptionError

if TYPE_CHECKING:
    from nanogs._types import F64
    from nanogs.place import Place

_on_earth = in_panel("Place on Earth (tileset.json)")


class Columns(NamedTuple):
    """The numbers of a transform, column after column."""

    numbers: tuple[float, ...]


def parse_columns(text: str) -> Columns:
    """A transform from 16 numbers with commas or spaces between.

    Raises:
        OptionError: They are not 16 numbers.
    """
    try:
        values = tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        values = ()
    if len(values) != 16:
        raise OptionError(
            "A transform is 16 numbers with commas between, column after column, as in"
            f" 1,0,0,0,0,1,0,0,0,0,1,0,10,20,30,1, not {text[:200]!r}."
        )
    return Columns(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Placing:
    """Where on Earth a scene is."""

    longitude: Annotated[
        float | None,
        _on_earth(
            "Of the scene's origin, degrees east of Greenwich; west is negative.", metavar="DEGREES"
        ),
    ] = None
    latitude: Annotated[
        float | None,
        _on_earth("Of the scene's origin, degrees north; south is negative.", metavar="DEGREES"),
    ] = None
    height: Annotated[
        float | None,
        _on_earth(
            "Of the scene's origin above the ellipsoid of WGS84, not the sea.",
            metavar="METRES",
            show_default="0",
        ),
    ] = None
    heading: Annotated[
        float | None,
        _on_earth(
            "Turn of the scene, clockwise from above; done last.",
            metavar="DEGREES",
            show_default="0",
        ),
    ] = None
    pitch: Annotated[
        float | None,
        _on_earth(
            "Tilt of the scene, its east side up; done second.",
            metavar="DEGREES",
            show_default="0",
        ),
    ] = None
    roll: Annotated[
        float | None,
        _on_earth(
            "Tilt of the scene, its north side up; done first.",
            metavar="DEGREES",
            show_default="0",
        ),
    ] = None
    transform: Annotated[
        Columns | None,
        _on_earth(
            "In place of these: 16 numbers with commas between, column after column, from the"
            " tiles' frame, z up, to Earth-centred, Earth-fixed coordinates.",
            parser=parse_columns,
            metavar="NUMBERS",
        ),
    ] = None

    @property
    def place(self) -> "Place | F64 | None":
        """The place that is asked for, as `chunks_of` takes it; None for none.

        Raises:
            OptionError: It is said in two ways or by half, or a number is out of its range.
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
                raise OptionError(f"--transform says all of a place; leave out --{min(given)}.")
            return from_columns(columns.numbers)
        if missing := {"longitude", "latitude"} - given.keys():
            raise OptionError(
                f"A place on Earth needs --longitude and --latitude; give --{max(missing)} too."
            )
        return Place(**given)
