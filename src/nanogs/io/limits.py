"""Errors and notes that are shared by the formats that cannot hold every model.

They are in one place so that every format words them alike.
"""

from collections.abc import Iterator

import numpy as np

from nanogs._types import Array, Bool
from nanogs.errors import OutputError, UnstorableError
from nanogs.findings import Finding, Names
from nanogs.formatting import counted
from nanogs.io import render_tag
from nanogs.io.columns import NORMALS
from nanogs.io.texts import printable
from nanogs.source import Source, source_of
from nanogs.splats import MAX_SH_DEGREE, RenderMode, Splats


def refuse_unstorable(model: Splats | Source, suffix: str) -> None:
    """Refuse values that a format cannot encode; infinite opacities and scales of zero are fine.

    Raises:
        OutputError: There is no splat, or one of them holds a NaN or an infinite value, or a centre
            outside the range of float32.
    """
    for _ in storable(source_of(model), suffix):
        pass


def refuse_empty(source: Source, suffix: str) -> None:
    """Refuse a model without splats, because its file could not be read back in any format.

    Raises:
        OutputError: The model has no splats.
    """
    if not source.count:
        raise UnstorableError(
            f"The model has no splats, but a {suffix} file needs at least one; give a model with"
            " splats."
        )


def refuse_long_json(size: int, most: int) -> None:
    """Refuse a JSON header of `size` bytes if readers take no more than `most`.

    Raises:
        OutputError: It is longer.
    """
    if size > most:
        raise OutputError(
            f"The JSON would have {size} bytes, and no more than {most} can be read back; shorten"
            " the comments."
        )


def storable(source: Source, suffix: str, rows: int | None = None) -> Iterator[Splats]:
    """Yield all blocks of a model and raise, after the last, if some value cannot be stored.

    Args:
        source: The model.
        suffix: Name of the format in the message.
        rows: Rows of a block; by default those of `Source.blocks`.

    Raises:
        OutputError: As for `refuse_unstorable`.
    """
    refuse_empty(source, suffix)
    first, wrong, at = 0, 0, 0
    for block in source.blocks(rows):
        good = _storable(block)
        if not good.all():
            first = first if wrong else at + int(np.argmin(good))
            wrong += int((~good).sum())
        at += len(block)
        yield block
    if wrong:
        raise UnstorableError(
            f"{counted(wrong, 'splat holds', 'splats hold')} NaN or infinite values, the first in"
            f" row {first}, which {suffix} cannot store; leave such splats out by converting with"
            " the filter `drop_nan`."
        )


def _storable(block: Splats) -> Bool:
    with np.errstate(over="ignore", invalid="ignore"):
        return block.finite() & np.isfinite(block.means.astype(np.float32)).all(axis=1)


def refused_splats(splats: Splats) -> int:
    """Return the number of splats for which `storable` raises."""
    return int((~_storable(splats)).sum())


def refusal(count: int, suffix: str, what: str = "NaN or infinite values") -> tuple[str, ...]:
    """Return the sentence that a format refuses a model for values of `count` splats, if any."""
    if not count:
        return ()
    text = f"{{:splat holds|splats hold}} {what}, {suffix} refuses the model."
    return (Finding(text, count),)


def left_out(
    splats: Splats,
    suffix: str,
    *,
    extras: bool = True,
    comments: bool = True,
    max_degree: int = MAX_SH_DEGREE,
) -> list[str]:
    """Return a sentence each for extra columns, elements, comments and SH bands that are left out.

    Args:
        splats: The model.
        suffix: Name of the format in the sentences.
        extras: Whether the format leaves extra columns out.
        comments: Whether the format leaves comments out.
        max_degree: Highest SH degree that the format holds.
    """
    out: list[str] = []
    with np.errstate(invalid="ignore"):
        # Most writers add normals of zero to every .ply; losing these is not worth a note.
        said = [name for name, each in splats.extras.items() if name not in NORMALS or each.any()]
    if extras and said:
        text = f"Extra columns are left out, {suffix} has no room for them: {{}}."
        out.append(Finding(text, Names(map(printable, said)), Names.union))
    if splats.elements:
        names = ", ".join(printable(element.name) for element in splats.elements)
        out.append(f"Further elements are left out, {suffix} has no room for them: {names}.")
    lines = [line for line in splats.comments if render_tag.tag_of(line) is None]
    if comments and lines:
        what = counted(len(lines), "comment line is", "comment lines are")
        them = "it" if len(lines) == 1 else "them"
        out.append(f"{what} left out, {suffix} has no room for {them}.")
    if splats.sh_degree > max_degree:
        out.append(degree_left_out(suffix, max_degree))
    return out


def degree_left_out(suffix: str, max_degree: int) -> str:
    """Return the sentence that SH bands above a degree are left out."""
    return f"Spherical harmonics above degree {max_degree} are left out, {suffix} holds no more."


def rounded(splats: Splats, suffix: str) -> list[str]:
    """Return a sentence if centres are rounded, because they need double precision."""
    if not is_rounded(splats.means):
        return []
    return [f"Centres in double precision are rounded, {suffix} holds single."]


def is_rounded(values: Array) -> bool:
    """Return whether single precision changes some of the numbers, of any type."""
    if values.dtype == np.float32:
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        same = values.astype(np.float32).astype(values.dtype) == values
    return not bool((same | (values != values)).all())


def lost_mode(splats: Splats, suffix: str, *held: RenderMode) -> list[str]:
    """Return a sentence if the model's render mode is none of those the format has a tag for."""
    if splats.render_mode in (RenderMode.DEFAULT, *held):
        return []
    tag = f"The render mode {splats.render_mode} is left out, {suffix} has no tag for it"
    return [f"{tag}: viewers will render the model as ordinary splats."]


def clamped(rows: Bool, what: str) -> list[str]:
    """Return a sentence if any splat has a value outside the range of the format.

    Args:
        rows: (N, ...) bool, true where a value is outside.
        what: The values and their range, inserted into the sentence.
    """
    count = int(rows.reshape(len(rows), -1).any(axis=1).sum())
    text = f"{{:splat has|splats have}} {what}; they are clamped to it."
    return [Finding(text, count)] if count else []
