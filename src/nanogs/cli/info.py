"""`nanogs info`."""

from pathlib import Path
from typing import Annotated

import typer

from nanogs.cli.console import key_value_table, out, print_json, warn
from nanogs.formatting import bytes_text
from nanogs.info import ModelInfo, describe


def info(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Model to read.")],
    json: Annotated[bool, typer.Option("--json", help="As JSON on stdout.")] = False,
) -> None:
    """Say what a model holds: splats, degree, bounds, opacities, scales, extra columns."""
    model = describe(source)
    if json:
        print_json(model.to_dict())
        return
    for note in model.notes:
        warn(note)
    out.print(key_value_table(_rows(model)))


def _rows(model: ModelInfo) -> dict[str, str]:
    file = model.file
    rows = {
        "file": f"{file.path} ({file.format}, {bytes_text(file.file_bytes)})",
        "splats": f"{file.splats:,}",
        "SH degree": str(file.sh_degree),
        "render mode": file.render_mode.value,
        "not finite": f"{model.nonfinite:,}",
        "alpha": _spread(model.alpha) + f"; {model.opaque:,} at 1, {model.transparent:,} at 0",
        "scale": _spread(model.scale),
    }
    if model.bounds:
        low, high = ([f"{value:.6g}" for value in corner] for corner in model.bounds)
        rows["bounds"] = f"{' '.join(low)} to {' '.join(high)}"
    if file.extras:
        rows["extra columns"] = ", ".join(file.extras)
    if file.elements:
        rows["elements"] = ", ".join(f"{name} ({count:,} rows)" for name, count in file.elements)
    if file.comments:
        rows["comments"] = "\n".join(file.comments)
    return rows


def _spread(quantiles: tuple[float, ...]) -> str:
    if not quantiles:
        return "none"
    low, tail, middle, head, high = quantiles
    return f"{low:.3g} to {high:.3g}, median {middle:.3g}, 90 % from {tail:.3g} to {head:.3g}"
