"""`nanogs info`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nanogs.cli import file_options, options
from nanogs.cli.groups import with_options
from nanogs.formatting import bytes_text, counted

if TYPE_CHECKING:
    from nanogs.io import FileInfo
    from nanogs.model_info import ModelInfo, Spread
    from nanogs.scoring.packing_cost import PackedFile, PackingCost

# By the name of the render mode.
_MODES = {"default": "default", "mip": "mip (antialiased)", "2dgs": "2dgs (flat splats)"}


@with_options
def info(
    *,
    source: Annotated[
        Path,
        typer.Argument(metavar="IN", help="Model to read: a file, its folder, or - for stdin."),
    ],
    read_as: file_options.From = None,
    render_mode: options.AsMode = None,
    packed: options.Packed = "",
    of_format: options.OfFormat,
    json: options.Json = False,
) -> None:
    """Say what a model holds, and what each other format would lose of it."""
    # What only a run needs is imported here, and not for `--help`.
    from nanogs.cli.console import key_value_table, out, print_json, show, warn
    from nanogs.cli.streams import Streams

    formats = options.parse_packed(packed, of_format)
    with Streams(read_as).received(source) as path:
        cost = _packing_cost(path, render_mode, formats, of_format, quiet=json) if formats else None
        model = _described(path, source, render_mode)
    if json:
        files = [file.to_dict() for file in cost.files] if cost else []
        print_json(model.to_dict() | {"packed": files})
        return
    notes = [f"{model.file.path}: {note}" for note in cost.notes] if cost else []
    for note in (*model.notes, *notes):
        warn(note)
    show(out, key_value_table(_rows(model) | (_packed_rows(cost.files) if cost else {})))


def _packing_cost(
    path: Path, mode: str | None, formats: list[str], of_format: dict[str, Any], *, quiet: bool
) -> "PackingCost":
    from nanogs.cli.progress import shown
    from nanogs.io import open as open_model
    from nanogs.io.collect import model_in
    from nanogs.scoring.packing_cost import packing_cost

    opened = open_model(model_in(path), render_mode=mode)
    with opened as model, shown(quiet=quiet) as progress:
        return packing_cost(model, formats, format_options=of_format, progress=progress)


def _packed_rows(files: Sequence["PackedFile"]) -> dict[str, str]:
    rows = {f"packed as {file.format}": file.text for file in files}
    return rows | {
        "measured": f"on {files[0].judged.protocol.text}: PSNR and SSIM of each file, read back,"
        " against the model itself"
    }


def _described(path: Path, source: Path, mode: str | None) -> "ModelInfo":
    """The contents of a file, called as the user calls it."""
    from nanogs.cli.blocks import DASH
    from nanogs.model_info import info as describe

    model = describe(path, render_mode=mode)
    if source != DASH:
        return model
    return replace(model, file=replace(model.file, path=Path("stdin")))


def _rows(model: "ModelInfo") -> dict[str, str]:
    file = model.file
    kinds = Counter(kind for _, kind in file.properties)
    rows = {
        "file": f"{file.path} ({file.format}, {bytes_text(file.file_bytes)})",
        "stored": f"{file.encoding}; columns: "
        + ", ".join(f"{count} {kind}" for kind, count in kinds.items()),
        "splats": f"{file.splats:,}",
        **_levels(model.levels),
        "SH degree": str(file.sh_degree),
        "render mode": _mode_text(file),
        "frame": model.frame,
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
        rows["elements"] = ", ".join(
            f"{name} ({counted(count, 'row')})" for name, count in file.elements
        )
    if file.comments:
        rows["comments"] = "\n".join(file.comments)
    whole = [suffix for suffix, sentences in model.losses.items() if not sentences]
    rows["fits whole into"] = ", ".join(whole) or "no format that is written"
    return rows | {f"as {name}": "\n".join(text) for name, text in model.losses.items() if text}


def _mode_text(file: "FileInfo") -> str:
    """The render mode, and what in the file says so."""
    return f"{_MODES[file.render_mode]}, {f'by {file.render_tag}' if file.render_tag else 'no tag'}"


def _levels(counts: Sequence[int]) -> dict[str, str]:
    """The levels of a stream, of which the finest is described."""
    text = ", ".join(f"{level}: {count:,}" for level, count in enumerate(counts))
    return {"levels": f"{text} splats; the rest is about 0, the finest"} if counts else {}


def _spread(spread: "Spread | None") -> str:
    if spread is None:
        return "none"
    return (
        f"{spread.min:.3g} to {spread.max:.3g}, median {spread.median:.3g},"
        f" 90 % from {spread.p5:.3g} to {spread.p95:.3g}"
    )
