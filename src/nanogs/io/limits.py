"""Refusals and losses of the formats that do not hold everything.

Said in one place, so that every such format says it alike.
"""

from collections.abc import Iterator

import numpy as np

from nanogs._types import Bool
from nanogs.errors import UnstorableError
from nanogs.findings import Finding, Names
from nanogs.formatting import counted
from nanogs.io import render_tag
from nanogs.io.columns import NORMALS
from nanogs.io.texts import printable
from nanogs.source import Source, source_of
from nanogs.splats import MAX_SH_DEGREE, RenderMode, Splats


def refuse_unstorable(model: Splats | Source, suffix: str) -> None:
    """Refuse what a format has no code for; infinite opacities and scales of zero are fine.

    Raises:
        OutputError: There is no splat, or one of them holds a NaN or an infinite value, or a centre
            beyond float32.
    """
    for _ in storable(source_of(model), suffix):
        pass


def refuse_empty(source: Source, suffix: str) -> None:
    """Refuse a model without splats, of which no format makes a file that could be read.

    Raises:
        OutputError: It is one.
    """
    if not source.count:
        raise UnstorableError(f"The model holds no splats, which a {suffix} file cannot say.")


def storable(source: Source, suffix: str) -> Iterator[Splats]:
    """All blocks of a model; at their end, what `refuse_unstorable` refuses is refused.

    Raises:
        OutputError: As said.
    """
    refuse_empty(source, suffix)
    first, wrong, at = 0, 0, 0
    for block in source.blocks():
        with np.errstate(over="ignore", invalid="ignore"):
            good = block.finite() & np.isfinite(block.means.astype(np.float32)).all(axis=1)
        if not good.all():
            first = first if wrong else at + int(np.argmin(good))
            wrong += int((~good).sum())
        at += len(block)
        yield block
    if wrong:
        raise UnstorableError(
            f"{counted(wrong, 'splat holds', 'splats hold')} NaN or infinite values, the first in"
            f" row {first}, which {suffix} has no code for; leave such splats out, as simplifying"
            " with `ratio=1` does."
        )


def left_out(
    splats: Splats,
    suffix: str,
    *,
    extras: bool = True,
    comments: bool = True,
    max_degree: int = MAX_SH_DEGREE,
) -> list[str]:
    """A sentence each for the columns, elements, comments, bands and digits that stay behind.

    Args:
        splats: The model.
        suffix: What the format is called in the sentences.
        extras: Whether it has no room for extra columns.
        comments: Whether it has none for comments.
        max_degree: The highest SH degree it holds.
    """
    out: list[str] = []
    with np.errstate(invalid="ignore"):
        # Most writers put normals of zero into every .ply, which say nothing.
        said = [name for name, each in splats.extras.items() if name not in NORMALS or each.any()]
    if extras and said:
        text = f"Extra columns are left out, {suffix} has no room for them: {{}}."
        out.append(Finding(text, Names(map(printable, said)), Names.union))
    if splats.elements:
        names = ", ".join(printable(element.name) for element in splats.elements)
        out.append(f"Further elements are left out, {suffix} has no room for them: {names}.")
    lines = [line for line in splats.comments if render_tag.tag_of(line) is None]
    if comments and lines:
        count = counted(len(lines), "comment line is", "comment lines are")
        out.append(f"{count} left out, {suffix} has no room for them.")
    if splats.sh_degree > max_degree:
        out.append(degree_left_out(suffix, max_degree))
    return out


def degree_left_out(suffix: str, max_degree: int) -> str:
    """Say that a format holds no more than a degree of harmonics."""
    return f"Spherical harmonics above degree {max_degree} are left out, {suffix} holds no more."


def rounded(splats: Splats, suffix: str) -> list[str]:
    """A sentence if centres in double precision are rounded to single."""
    if splats.means.dtype == np.float32:
        return []
    return [f"Centres in double precision are rounded, {suffix} holds single."]


def lost_mode(splats: Splats, suffix: str, *held: RenderMode) -> list[str]:
    """A sentence if the format has no tag for the model's render mode."""
    if splats.render_mode in (RenderMode.DEFAULT, *held):
        return []
    tag = f"The render mode {splats.render_mode} is left out, {suffix} has no tag for it"
    return [f"{tag}: viewers will render the model as ordinary splats."]


def clamped(rows: Bool, what: str) -> list[str]:
    """A sentence if any splat has a value outside what the format holds.

    Args:
        rows: (N, ...) bool, true where a value is outside.
        what: The values and their range, to end the sentence.
    """
    count = int(rows.reshape(len(rows), -1).any(axis=1).sum())
    text = f"{{:splat has|splats have}} {what}, clamped to that."
    return [Finding(text, count)] if count else []
