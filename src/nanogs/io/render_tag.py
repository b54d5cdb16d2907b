"""Render mode tags in PLY comments: `SplatRenderMode: mip`, or `antialiased 1`.

As in the field's other readers, case does not matter and the last tag wins.
"""

import re
from collections.abc import Sequence

from nanogs.splats import RenderMode

_TAG = re.compile(
    r"\s*(?:splatrendermode:\s*(default|mip|2dgs)|antialiased\s+([01]))\s*", re.IGNORECASE
)
TWO_SCALES = "its two scales per splat"  # of 2DGS; the text for `FileInfo.render_tag`
THIRD_SCALE = "Splats have two scales, as 2DGS trains them; the third was read as 0."
_ANTIALIASED = {"0": RenderMode.DEFAULT, "1": RenderMode.MIP}


def tag_of(comment: str) -> RenderMode | None:
    """Parse the render mode that one comment line states; None if it states none."""
    match = _TAG.fullmatch(comment)
    if match is None:
        return None
    mode, flag = match.groups()
    return RenderMode(mode.lower()) if mode else _ANTIALIASED[flag]


def render_mode(comments: Sequence[str]) -> RenderMode:
    """Return the render mode that a file's comments state; the default without a tag."""
    tags = [tag for tag in map(tag_of, comments) if tag is not None]
    return tags[-1] if tags else RenderMode.DEFAULT


def described(comments: Sequence[str]) -> str:
    """Return the text for `FileInfo.render_tag`: the comment that states the render mode, or ""."""
    stated = [comment.strip() for comment in comments if tag_of(comment) is not None]
    return f'the comment "{stated[-1]}"' if stated else ""


def contradiction(comments: Sequence[str]) -> list[str]:
    """Return a note for the user if the comments state more than one render mode."""
    tags = {tag for tag in map(tag_of, comments) if tag is not None}
    if len(tags) < 2:
        return []
    last = render_mode(comments)
    return [f"The comments state {len(tags)} render modes; the last one ({last}) was taken."]


def agreeing(comments: Sequence[str], mode: RenderMode) -> list[str]:
    """Return the comments without the tags of other render modes."""
    return [comment for comment in comments if tag_of(comment) in (None, mode)]


def tagged(comments: Sequence[str], mode: RenderMode) -> list[str]:
    """Return the comments to write: tags of other modes removed, that of `mode` added if needed."""
    kept = agreeing(comments, mode)
    stated = any(tag_of(comment) is mode for comment in kept)
    if mode is RenderMode.DEFAULT or stated:
        return kept
    return [*kept, f"SplatRenderMode: {mode}"]
