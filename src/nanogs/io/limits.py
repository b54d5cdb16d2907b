"""What the formats that do not hold everything refuse, and what they leave out.

Said in one place, so that every such format says it alike.
"""

from nanogs._types import Bool
from nanogs.errors import OutputError
from nanogs.io import render_tag
from nanogs.io.columns import NORMALS
from nanogs.splats import RenderMode, Splats


def refuse_unstorable(splats: Splats, suffix: str) -> None:
    """Refuse what a format of quantised values has no code for; infinite opacities are fine.

    Raises:
        OutputError: There is no splat, or one of them holds a NaN or an infinite value.
    """
    if not len(splats):
        raise OutputError(f"The model holds no splats, which a {suffix} file cannot say.")
    if bad := int((~splats.finite()).sum()):
        raise OutputError(
            f"{bad:,} splats hold NaN or infinite values, which {suffix} has no code for; leave"
            " them out first, as nanogs simplify does."
        )


def left_out(splats: Splats, suffix: str, *, extras: bool = True) -> list[str]:
    """A sentence each for the extra columns, further elements and comments of a model."""
    out = []
    # Most writers put normals of zero into every .ply, which say nothing.
    said = [name for name, column in splats.extras.items() if name not in NORMALS or column.any()]
    if extras and said:
        names = ", ".join(said)
        out.append(f"Extra columns are left out, {suffix} has no room for them: {names}.")
    if splats.elements:
        names = ", ".join(element.name for element in splats.elements)
        out.append(f"Further elements are left out, {suffix} has no room for them: {names}.")
    comments = [line for line in splats.comments if render_tag.tag_of(line) is None]
    if comments:
        lines = "1 comment line is" if len(comments) == 1 else f"{len(comments)} comment lines are"
        out.append(f"{lines} left out, {suffix} has no room for them.")
    return out


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
    return [f"{count:,} splats have {what}, and are clamped to that."] if count else []
