"""The render mode as PLY comments state it: `SplatRenderMode: mip`, or `antialiased 1`.

As in the field's other readers, case does not matter and the last tag wins.
"""

import re
from collections.abc import Sequence

from nanogs.splats import RenderMode

_TAG = re.compile(
    r"\s*(?:splatrendermode:\s*(default|mip|2dgs)|antialiased\s+([01]))\s*", re.IGNORECASE
)
_ANTIALIASED = {"0": RenderMode.DEFAULT, "1": RenderMode.MIP}


def tag_of(comment: str) -> RenderMode | None:
    """The render mode that one comment line states, or None."""
    match = _TAG.fullmatch(comment)
    if match is None:
        return None
    mode, flag = match.groups()
    return RenderMode(mode.lower()) if mode else _ANTIALIASED[flag]


def render_mode(comments: Sequence[str]) -> RenderMode:
    """The render mode that a file's comments state; the default without a tag."""
    tags = [tag for tag in map(tag_of, comments) if tag is not None]
    return tags[-1] if tags else RenderMode.DEFAULT


def described(comments: Sequence[str]) -> str:
    """The comment that states the render mode, as `FileInfo.render_tag` has it."""
    stated = [comment.strip() for comment in comments if tag_of(comment) is not None]
    return f'the comment "{stated[-1]}"' if stated else ""


def contradiction(comments: Sequence[str]) -> list[str]:
    """A note for the user when the comments state more than one render mode."""
    tags = {tag for tag in map(tag_of, comments) if tag is not None}
    if len(tags) < 2:
        return []
    last = render_mode(comments)
    return [f"The comments state {len(tags)} render modes; the last one ({last}) was taken."]


def agreeing(comments: Sequence[str], mode: RenderMode) -> list[str]:
    """The comments without the tags of other render modes."""
    return [comment for comment in comments if tag_of(comment) in (None, mode)]


def tagged(comments: Sequence[str], mode: RenderMode) -> list[str]:
    """The comments to write: those given, with exactly the tags that agree with `mode`."""
    kept = agreeing(comments, mode)
    stated = any(tag_of(comment) is mode for comment in kept)
    if mode is RenderMode.DEFAULT or stated:
        return kept
    return [*kept, f"SplatRenderMode: {mode}"]
