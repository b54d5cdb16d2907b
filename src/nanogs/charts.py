"""Line charts as SVG, for pages and for files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

Points = Sequence[tuple[float, float]]

_WIDTH, _HEIGHT = 440, 300  # plot area, pixels
_LEFT, _TOP, _BOTTOM, _LEGEND = 70, 40, 60, 190  # margins, and the legend on the right
_COLOURS = (
    "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f",
    "#bcbd22", "#17becf",
)  # fmt: skip
# Around a point: the first for the first use of the colours, the next for their second, and so on.
_DOTS = (
    '<circle cx="{x:.1f}" cy="{y:.1f}" r="4"/>',
    '<path d="M{x:.1f} {y:.1f}m-4-4h8v8h-8z"/>',
    '<path d="M{x:.1f} {y:.1f}m0-5l5 9h-10z"/>',
    '<path d="M{x:.1f} {y:.1f}m0-5l5 5-5 5-5-5z"/>',
)
_ENTRY = 20  # height of a line of the legend, pixels
_LETTERS = 23  # most characters of a name in the legend


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart of PSNR, in dB, over a quantity on a logarithmic axis.

    Attributes:
        title: Title above the chart.
        across: Label of the horizontal axis.
        lines: Points (x, PSNR) of each line by name; x above 0, both finite.
    """

    title: str
    across: str
    lines: Mapping[str, Points]


@dataclass(frozen=True, slots=True)
class _Axis:
    """A linear axis from `low` to `high` over a number of pixels; values may be logarithms."""

    low: float
    high: float
    pixels: int

    def place(self, value: float) -> float:
        return self.pixels * (value - self.low) / (self.high - self.low)


def svg(charts: Sequence[Chart], columns: int | None = None) -> str:
    """Draw charts in rows as one SVG element.

    Args:
        charts: The charts, row by row.
        columns: Number of charts in a row; by default all.
    """
    columns = columns or max(len(charts), 1)
    across = _LEFT + _WIDTH + _LEGEND
    entries = max((len(chart.lines) for chart in charts), default=0)
    down = _TOP + max(_HEIGHT + _BOTTOM, _ENTRY * (entries + 1))
    drawn = ""
    for place, chart in enumerate(charts):
        row, column = divmod(place, columns)
        at = f"translate({column * across + _LEFT} {row * down + _TOP})"
        drawn += f'<g transform="{at}">{_drawn(chart)}</g>'
    width, height = across * columns, down * max(-(-len(charts) // columns), 1)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}"'
        f' height="{height}" font-family="sans-serif" font-size="13" fill="#222">'
        f'<rect width="100%" height="100%" fill="#fff"/>{drawn}</svg>\n'
    )


def ticks(chart: Chart) -> list[float]:
    """Return the tick values of the horizontal axis, ascending; none for a chart without points."""
    x = [math.log10(point[0]) for line in chart.lines.values() for point in line]
    return _marks(_axis(x, _WIDTH)) if x else []


def tick_text(value: float) -> str:
    """Return the label of a tick of the horizontal axis."""
    return f"{value:,.10g}"


def _drawn(chart: Chart) -> str:
    x = [math.log10(point[0]) for line in chart.lines.values() for point in line]
    y = [point[1] for line in chart.lines.values() for point in line]
    across, up = _axis(x, _WIDTH), _axis(y, _HEIGHT)
    parts = [
        _text(_WIDTH / 2, -14, chart.title, size=14),
        _text(_WIDTH / 2, _HEIGHT + 44, chart.across),
        f'<g transform="translate(-50 {_HEIGHT / 2}) rotate(-90)">{_text(0, 0, "PSNR (dB)")}</g>',
        f'<path d="M0 0V{_HEIGHT}H{_WIDTH}" fill="none" stroke="#222"/>',
    ]
    parts += [_mark(across.place(math.log10(value)), value) for value in ticks(chart)]
    if y:
        parts += [_rule(_HEIGHT - up.place(value), value) for value in _steps(up)]
    for number, (name, line) in enumerate(chart.lines.items()):
        places = [(across.place(math.log10(a)), _HEIGHT - up.place(b)) for a, b in sorted(line)]
        parts.append(_line(places, name, number))
    return "".join(parts)


def _axis(values: Sequence[float], pixels: int) -> _Axis:
    """Make an axis that spans the values, with a margin at both ends."""
    low, high = min(values, default=0.0), max(values, default=1.0)
    room = 0.05 * (high - low) or 0.5
    return _Axis(low - room, high + room, pixels)


def _marks(axis: _Axis) -> list[float]:
    """Choose tick values for a logarithmic axis, ascending.

    Powers of ten; on a short axis 2 and 5 times these too; equidistant values if that gives fewer
    than two.
    """
    exponents = range(math.floor(axis.low), math.ceil(axis.high) + 1)
    leads = (1, 2, 5) if axis.high - axis.low < 2.5 else (1,)
    values = [lead * 10.0**exponent for exponent in exponents for lead in leads]
    found = [value for value in values if axis.low <= math.log10(value) <= axis.high]
    return found if len(found) > 1 else _steps(_Axis(10**axis.low, 10**axis.high, axis.pixels))


def _steps(axis: _Axis) -> list[float]:
    """Choose three to seven round tick values for a linear axis."""
    least = (axis.high - axis.low) / 7
    power = 10.0 ** math.floor(math.log10(least))
    step = next(lead * power for lead in (1, 2, 5, 10) if lead * power >= least)
    return [n * step for n in range(math.ceil(axis.low / step), math.floor(axis.high / step) + 1)]


def _mark(x: float, value: float) -> str:
    line = f'<path d="M{x:.1f} 0V{_HEIGHT + 5}" stroke="#0002"/>'
    return line + _text(x, _HEIGHT + 22, tick_text(value))


def _rule(y: float, value: float) -> str:
    line = f'<path d="M-5 {y:.1f}H{_WIDTH}" stroke="#0002"/>'
    return line + _text(-9, y + 4, f"{value:.10g}", anchor="end")


def _line(places: Points, name: str, number: int) -> str:
    """Draw a line with dots, and its entry in the legend."""
    colour = _COLOURS[number % len(_COLOURS)]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    dot = _DOTS[number // len(_COLOURS) % len(_DOTS)]
    dots = "".join(dot.format(x=x, y=y) for x, y in places)
    height = 8 + _ENTRY * number
    return (
        f'<g fill="{colour}"><polyline points="{points}" fill="none" stroke="{colour}"'
        f' stroke-width="1.8"/>{dots}{dot.format(x=_WIDTH + 16, y=height)}</g>'
        + _text(_WIDTH + 26, height + 4, name, anchor="start", letters=_LETTERS)
    )


def _text(
    x: float,
    y: float,
    text: str,
    *,
    anchor: str = "middle",
    size: int = 13,
    letters: int | None = None,
) -> str:
    """Write a text; one of more than `letters` loses its middle, and a tooltip has it whole."""
    shown, tip = text, ""
    if letters and len(text) > letters:
        # Names of files often differ in their last letters.
        half = letters // 2
        shown, tip = f"{text[:half]}…{text[-half:]}", f"<title>{escape(text)}</title>"
    placed = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}"'
    return f"<text {placed}>{escape(shown)}{tip}</text>"
