"""`nanogs info`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nanogs.cli import file_options, options, parsing
from nanogs.cli.groups import with_options
from nanogs.cli.looking import RenderOptions
from nanogs.formatting import bytes_text, counted, number_text

if TYPE_CHECKING:
    from nanogs.io import FileInfo
    from nanogs.io.parts import FileSource
    from nanogs.model_info import Distribution, ModelInfo
    from nanogs.scoring.modes import RenderFindings
    from nanogs.scoring.packing_cost import PackedFile, PackingCost

_HINT = "; --views 8 shows the evidence for it"
# Texts by name of the render mode.
_MODES = {"default": "default", "mip": "mip (antialiased)", "2dgs": "2dgs (flat splats)"}


@with_options
def info(
    *,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="IN",
            parser=parsing.parse_path,
            help="Model to read: a file, its folder, its URL (https://, s3://), or - for stdin.",
        ),
    ],
    columns: Annotated[
        bool, typer.Option("--columns", help="Also print statistics of each column.")
    ] = False,
    level: options.Level = 0,
    read_as: file_options.From = None,
    render_mode: options.AsMode = None,
    packed: options.Packed = None,
    of_format: options.OfFormat,
    looking: RenderOptions,
    json: options.Json = False,
) -> None:
    """Print what a model holds, and what each other format would lose of it.

    With --views or --photos also how costly it is to draw, and how it should be drawn.
    """
    # Imported here because `--help` does not need it.
    from nanogs.cli.console import entry_table, key_value_table, out, print_json, show, warn
    from nanogs.cli.streams import Streams
    from nanogs.io import open as open_model
    from nanogs.io.collect import model_in
    from nanogs.io.texts import printable

    formats, looks = parsing.parse_packed(packed, of_format), looking.asked(packed=bool(packed))
    with Streams(read_as).received(source, quiet=json) as path:
        cost, looked = None, None
        if formats or looks:
            with open_model(model_in(path), level=level, render_mode=render_mode) as opened:
                if formats:
                    cost = _packing_cost(opened, formats, of_format, looking, quiet=json)
                if looks:
                    looked = _looked(opened, looking, quiet=json)
        model = _described(path, source, level, render_mode, columns=columns)
    notes = [*model.notes, *(looked.notes if looked else ())]
    notes += [f"{model.file.path}: {note}" for note in cost.notes] if cost else []
    if json:
        files = [file.to_dict() for file in cost.files] if cost else []
        seen: dict[str, Any] = {"mode_evidence": None, "draw_cost": None}
        if looked:
            drawn = looked.cost.to_dict() if looked.cost else None
            seen = {"mode_evidence": looked.modes.to_dict(), "draw_cost": drawn}
        print_json(model.to_dict() | {"packed": files, "notes": notes} | seen)
        return
    for note in notes:
        warn(note)
    rows = _rows(model, level, looked is not None) | (_packed_rows(cost.files) if cost else {})
    show(out, key_value_table(rows | (_looked_rows(looked) if looked else {})))
    if model.columns:
        entries = [replace(each, column=printable(each.column)) for each in model.columns]
        show(out, entry_table(entries))


def _packing_cost(
    model: "FileSource",
    formats: list[str],
    of_format: dict[str, Any],
    looking: RenderOptions,
    *,
    quiet: bool,
) -> "PackingCost":
    from nanogs.cli.progress import shown
    from nanogs.scoring.packing_cost import packing_cost

    with shown(quiet=quiet) as progress:
        return packing_cost(
            model, formats, format_options=of_format, threads=looking.threads,
            max_memory=looking.max_memory, progress=progress,
        )  # fmt: skip


def _looked(model: "FileSource", looking: RenderOptions, *, quiet: bool) -> "RenderFindings":
    from nanogs.cli.progress import shown

    with shown(quiet=quiet) as progress:
        return looking.looked(model, progress)


def _looked_rows(looked: "RenderFindings") -> dict[str, str]:
    cost = looked.cost
    drawn = {"to draw": f"{cost.text}, on {cost.protocol.text}"} if cost else {}
    return drawn | {
        "default or mip": "\n".join(looked.modes.sentences)
        + "\n(evidence, not proof; the renders in the two modes are"
        f" {number_text(looked.modes.between)} dB apart)",
    }


def _packed_rows(files: Sequence["PackedFile"]) -> dict[str, str]:
    rows = {f"packed as {file.format}": file.text for file in files}
    return rows | {
        "measured": f"on {files[0].judged.protocol.text}: PSNR and SSIM of each file, read back,"
        " against the model itself"
    }


def _described(
    path: Path, source: Path, level: int, mode: str | None, *, columns: bool
) -> "ModelInfo":
    """Describe a file; one from stdin is named "stdin" instead of its temporary file."""
    from nanogs.cli.blocks import DASH
    from nanogs.model_info import info as describe

    model = describe(path, level=level, columns=columns, render_mode=mode)
    if source != DASH:
        return model
    return replace(model, file=replace(model.file, path=Path("stdin")))


def _rows(model: "ModelInfo", level: int, looked: bool) -> dict[str, str]:
    from nanogs.io.texts import printable

    file = model.file
    kinds = Counter(kind for _, kind in file.properties)
    rows = {
        "file": f"{file.path} ({file.format}, {bytes_text(file.file_bytes)})",
        "stored": f"{file.encoding}; columns: "
        + ", ".join(f"{count} {kind}" for kind, count in kinds.items()),
        "splats": f"{file.splats:,}",
        **_levels(model.levels, level),
        **_environment(model.environment),
        "SH degree": str(file.sh_degree),
        "render mode": _mode_text(file) + ("" if looked else _HINT),
        "frame": model.frame,
        "not finite": f"{model.nonfinite:,}",
        "alpha": _spread(model.alpha) + f"; {model.opaque:,} at 1, {model.transparent:,} at 0",
        "scale": _spread(model.scale),
    }
    if model.bounds:
        low, high = ([f"{value:.6g}" for value in corner] for corner in model.bounds)
        rows["bounds"] = f"{' '.join(low)} to {' '.join(high)}"
    if file.extras:
        rows["extra columns"] = ", ".join(map(printable, file.extras))
    if file.elements:
        rows["elements"] = ", ".join(
            f"{printable(name)} ({counted(count, 'row')})" for name, count in file.elements
        )
    if file.comments:
        rows["comments"] = "\n".join(file.comments)
    whole = [suffix for suffix, sentences in model.losses.items() if not sentences]
    rows["fits whole into"] = ", ".join(whole) or "no format that nanogs writes"
    return rows | {f"as {name}": "\n".join(text) for name, text in model.losses.items() if text}


def _mode_text(file: "FileInfo") -> str:
    """Format the render mode and the tag in the file that sets it."""
    return f"{_MODES[file.render_mode]}, {f'by {file.render_tag}' if file.render_tag else 'no tag'}"


def _levels(counts: Sequence[int], level: int) -> dict[str, str]:
    """Return the row of a stream's levels; the other rows describe one of them."""
    text = ", ".join(f"{number}: {count:,}" for number, count in enumerate(counts))
    which = f"level {level}" if level else "level 0, the finest"
    return {"levels": f"{text} splats; the other rows describe {which}"} if counts else {}


def _environment(splats: int) -> dict[str, str]:
    return {"environment": f"{splats:,} of the splats of every level"} if splats else {}


def _spread(spread: "Distribution | None") -> str:
    if spread is None:
        return "none"
    return (
        f"{spread.min:.3g} to {spread.max:.3g}, median {spread.median:.3g},"
        f" 90 % from {spread.p5:.3g} to {spread.p95:.3g}"
    )
