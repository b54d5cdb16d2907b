"""Line charts as SVG, for pages and for files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import pairwise

Points = Sequence[tuple[float, float]]

_BOTTOM = 60  # margin for the labels of the horizontal axis, pixels
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
_DIGIT, _COMMA = 8, 4  # widths of these in a wide font, pixels
_GAP = 8  # least distance of two labels of an axis, pixels
_LEAST = 1.0  # least span of the PSNR axis, dB; labels of much shorter ones reach into its title


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
class _Layout:
    """Sizes of a chart, in pixels.

    Attributes:
        width: Width of the plot area.
        height: Height of the plot area.
        left: Margin on the left.
        right: Margin on the right.
        top: Margin above.
        names: Position of the legend's upper left corner in the plot area.
        letters: Most characters of a name in the legend.
    """

    width: int
    height: int
    left: int
    right: int
    top: int
    names: tuple[int, int]
    letters: int

    @property
    def across(self) -> int:
        """Width of the whole chart."""
        return self.left + self.width + self.right

    def down(self, entries: int) -> int:
        """Return the height of the whole chart with a number of lines."""
        legend = self.names[1] + _ENTRY * (entries + 1)
        return self.top + max(self.height + _BOTTOM, legend if entries else 0)


_WIDE = _Layout(440, 300, left=70, right=190, top=40, names=(440, 0), letters=23)
_NARROW = _Layout(266, 220, left=60, right=24, top=10, names=(-50, 220 + _BOTTOM), letters=38)


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

    Texts and axes have the CSS colour of the element, and its only rectangle is the background, so
    that a page can give them others.

    Args:
        charts: The charts, row by row.
        columns: Number of charts in a row; by default all.
    """
    return _svg(charts, columns or max(len(charts), 1), _WIDE)


def narrow_svg(chart: Chart) -> str:
    """Draw a chart like `svg`, for a page on a phone: its legend is below, its title left out."""
    return _svg([replace(chart, title="")], 1, _NARROW)


def _svg(charts: Sequence[Chart], columns: int, layout: _Layout) -> str:
    across = layout.across
    down = layout.down(max((len(chart.lines) for chart in charts), default=0))
    drawn = ""
    for place, chart in enumerate(charts):
        row, column = divmod(place, columns)
        at = f"translate({column * across + layout.left} {row * down + layout.top})"
        drawn += f'<g transform="{at}">{_drawn(chart, layout)}</g>'
    width, height = across * columns, down * max(-(-len(charts) // columns), 1)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}"'
        f' height="{height}" font-family="sans-serif" font-size="13" color="#222"'
        f' fill="currentColor"><rect width="100%" height="100%" fill="#fff"/>{drawn}</svg>\n'
    )


def ticks(chart: Chart) -> list[float]:
    """Return the tick values of the horizontal axis of `svg`, ascending; none without points."""
    return _ticks(chart, _WIDE)


def _ticks(chart: Chart, layout: _Layout) -> list[float]:
    x = [math.log10(point[0]) for line in chart.lines.values() for point in line]
    return _marks(_axis(x, layout.width)) if x else []


def tick_text(value: float) -> str:
    """Return the label of a tick of the horizontal axis."""
    return f"{value:,.10g}"


def _drawn(chart: Chart, layout: _Layout) -> str:
    width, height = layout.width, layout.height
    x = [math.log10(point[0]) for line in chart.lines.values() for point in line]
    y = [point[1] for line in chart.lines.values() for point in line]
    across, up = _axis(x, width), _axis(y, height, _LEAST)
    parts = [
        _text(width / 2, -14, chart.title, size=14),
        _text(width / 2, height + 44, chart.across),
        f'<g transform="translate(-50 {height / 2}) rotate(-90)">{_text(0, 0, "PSNR (dB)")}</g>',
        f'<path d="M0 0V{height}H{width}" fill="none" stroke="currentColor"/>',
    ]
    for value in _ticks(chart, layout):
        place = across.place(math.log10(value))
        parts.append(_grid_line(f"M{place:.1f} 0V{height + 5}"))
        parts.append(_text(place, height + 22, tick_text(value)))
    for value in _steps(up) if y else []:
        place = height - up.place(value)
        parts.append(_grid_line(f"M-5 {place:.1f}H{width}"))
        parts.append(_text(-9, place + 4, f"{value:.10g}", anchor="end"))
    for number, (name, line) in enumerate(chart.lines.items()):
        places = [(across.place(math.log10(a)), height - up.place(b)) for a, b in sorted(line)]
        parts.append(_line(places, name, number, layout))
    return "".join(parts)


def _axis(values: Sequence[float], pixels: int, least: float = 0.0) -> _Axis:
    """Make an axis that spans the values, with a margin at both ends, and at least `least`."""
    low, high = min(values, default=0.0), max(values, default=1.0)
    room = max(0.05 * (high - low), (least - (high - low)) / 2) or 0.5
    return _Axis(low - room, high + room, pixels)


def _marks(axis: _Axis) -> list[float]:
    """Choose tick values for a logarithmic axis, ascending, whose labels do not touch.

    Powers of ten; on a short axis 2 and 5 times these too; equidistant values if that gives fewer
    than two.
    """
    linear = _Axis(10**axis.low, 10**axis.high, axis.pixels)
    choices = [_powers(axis, (1, 2, 5))] if axis.high - axis.low < 2.5 else []
    choices += [_powers(axis, (1,)), *(_steps(linear, most) for most in (7, 5, 3))]
    choices = [values for values in choices if len(values) > 1]
    return next((values for values in choices if _are_apart(values, axis)), choices[-1])


def _powers(axis: _Axis, leads: Sequence[int]) -> list[float]:
    """Return the leads times powers of ten on a logarithmic axis, ascending."""
    exponents = range(math.floor(axis.low), math.ceil(axis.high) + 1)
    values = [lead * 10.0**exponent for exponent in exponents for lead in leads]
    return [value for value in values if axis.low <= math.log10(value) <= axis.high]


def _are_apart(values: Sequence[float], axis: _Axis) -> bool:
    """Return whether labels at ascending values of a logarithmic axis leave gaps between them."""
    places = [axis.place(math.log10(value)) for value in values]
    widths = [sum(_DIGIT if a.isdigit() else _COMMA for a in tick_text(v)) for v in values]
    return all(
        after - before >= (one + other) / 2 + _GAP
        for (before, after), (one, other) in zip(pairwise(places), pairwise(widths), strict=True)
    )


def _steps(axis: _Axis, most: int = 7) -> list[float]:
    """Choose at most some round tick values for a linear axis; of seven there are two or more."""
    least = (axis.high - axis.low) / most
    power = 10.0 ** math.floor(math.log10(least))
    step = next(lead * power for lead in (1, 2, 5, 10) if lead * power >= least)
    return [n * step for n in range(math.ceil(axis.low / step), math.floor(axis.high / step) + 1)]


def _grid_line(path: str) -> str:
    return f'<path d="{path}" stroke="currentColor" stroke-opacity=".13"/>'


def _line(places: Points, name: str, number: int, layout: _Layout) -> str:
    """Draw a line with dots, and its entry in the legend."""
    colour = _COLOURS[number % len(_COLOURS)]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    dot = _DOTS[number // len(_COLOURS) % len(_DOTS)]
    dots = "".join(dot.format(x=x, y=y) for x, y in places)
    left, top = layout.names
    x, y = left + 16, top + 8 + _ENTRY * number
    return (
        f'<g fill="{colour}"><polyline points="{points}" fill="none" stroke="{colour}"'
        f' stroke-width="1.8"/>{dots}{dot.format(x=x, y=y)}</g>'
        + _text(x + 10, y + 4, name, anchor="start", letters=layout.letters)
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
