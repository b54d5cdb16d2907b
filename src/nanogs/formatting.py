"""Numbers as people read them, the same on the terminal and on pages."""

import math

NONE = "–"  # noqa: RUF001 - an en dash stands for "no value"


def number_text(value: float | None, digits: int = 2) -> str:
    """A rounded number with commas at thousands, the sign of infinity, or a dash for none."""
    if value is None or math.isnan(value):
        return NONE
    return "∞" if math.isinf(value) else f"{value:,.{digits}f}"


def bytes_text(count: int | None) -> str:
    """Bytes in the unit that fits: 1,500,000 becomes 1.5 MB; a dash for none."""
    if count is None:
        return NONE
    value = float(count)
    for unit in ("B", "KB", "MB"):
        if value < 999.95:  # and not 1000.0 of a unit
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"
