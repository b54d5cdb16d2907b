"""Options of `nanogs info` for rendering, and checks of options for views that exclude others."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nanogs.cli import options, parsing
from nanogs.errors import OptionError
from nanogs.protocol import PIXELS, VIEWS

if TYPE_CHECKING:
    from nanogs.io.models import Model
    from nanogs.progress import Progress
    from nanogs.scoring.modes import RenderFindings

_view = options.in_panel(options.VIEWS)
Given = dict[str, object]
"""Values of options by name; None for an option that was not given."""


def refuse_beside_photos(photos: Path | None, of_photos: Given, found: Given) -> None:
    """Refuse options for photographs without --photos, and for automatic views with it.

    Args:
        photos: Value of --photos.
        of_photos: Options for photographs.
        found: Options for automatic views and --cameras.

    Raises:
        OptionError: Such an option is given.
    """
    for option, value in (of_photos if photos is None else found).items():
        if value is not None and photos is None:
            raise OptionError(
                f"{option} works only with photographs; name their folder with --photos."
            )
        if value is not None:
            raise OptionError(
                f"{option} cannot be combined with --photos, which has views of its own; leave"
                " one of them out."
            )


def refuse_without_views(rendered: bool, needed: str, options: Given) -> None:
    """Refuse options for rendering if nothing that they apply to is rendered.

    Args:
        rendered: Whether something is.
        needed: The options that cause it, as words.
        options: Options for rendering.

    Raises:
        OptionError: Such an option is given without one of those.
    """
    for option, value in options.items():
        if value is not None and not rendered:
            raise OptionError(
                f"{option} works only with {needed}; add one of these, such as --views 8, or leave"
                " it out."
            )


def refuse_beside_file(cameras: str | None, found: Given) -> None:
    """Refuse options for automatic views if cameras are read from a file.

    Args:
        cameras: Value of --cameras; a path that does not exist is reported later.
        found: Options for automatic views.

    Raises:
        OptionError: Such an option is given beside a file.
    """
    given = next((option for option, value in found.items() if value is not None), None)
    if cameras is None or given is None:
        return
    from nanogs.paths import exists
    from nanogs.views.cameras import FOUND

    if cameras not in FOUND and exists(cameras):
        raise OptionError(
            f"{given} cannot be combined with --cameras {cameras}, which has views of its own;"
            " leave one of them out."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """Options for rendering the model; None for those that are not given."""

    views: Annotated[
        int | None,
        _view(
            "Render this many automatic views, to show how costly the model is to draw, and the"
            " evidence for either render mode.",
            "--views",
            min=1,
        ),
    ] = None
    pixels: Annotated[str | None, options.pixels(PIXELS)] = None
    cameras: Annotated[
        str | None,
        _view(
            "Views to render: a file or folder of cameras, or auto, orbit, inside, roam.",
            parser=parsing.parse_cameras,
            metavar="CAMERAS",
        ),
    ] = None
    up: options.Up = None
    photos: Annotated[
        Path | None,
        _view(
            "Render the model in both modes, default and mip, and score both against the"
            " photographs of this data set (folder of NeRF-Synthetic, nerfstudio or COLMAP).",
            parser=parsing.parse_local,
            metavar="FOLDER",
        ),
    ] = None
    images: options.PhotoImages = None
    split: options.PhotoSplit = None
    background: options.PhotoBackground = None
    threads: options.Threads = None
    max_memory: options.MaxMemory = None

    def asked(self, *, packed: bool) -> bool:
        """Return whether the options request renders of the model.

        Args:
            packed: Whether --packed is given, which renders the model in any case.

        Raises:
            OptionError: Options for photographs or automatic views are given without these, or
                exclude each other.
        """
        of_photos: Given = {"--images": self.images, "--split": self.split}
        found: Given = {"--views": self.views, "--pixels": self.pixels, "--up": self.up}
        refuse_beside_photos(self.photos, of_photos, {"--cameras": self.cameras, **found})
        refuse_beside_file(self.cameras, found)
        found["--cameras"] = self.cameras
        looks = bool(self.photos) or any(value is not None for value in found.values())
        rendering: Given = {"--threads": self.threads, "--max-memory": self.max_memory}
        refuse_without_views(looks, "--views or --photos", {"--background": self.background})
        refuse_without_views(looks or packed, "--views, --photos or --packed", rendering)
        return looks

    def looked(self, model: "Model", progress: "Progress") -> "RenderFindings":
        """Render a model, for evidence of its render mode and its draw cost.

        Raises:
            NanogsError: As for `nanogs.mode_evidence`.
        """
        from nanogs.scoring.modes import ModelViews, render_findings
        from nanogs.scoring.view_sets import Photographs

        behind = None if self.background is None else parsing.parse_background(self.background)
        seen: ModelViews | Photographs
        if self.photos is not None:
            seen = Photographs(
                self.photos, self.images, "test" if self.split is None else self.split
            )
        else:
            pixels = parsing.parse_pixels(str(PIXELS) if self.pixels is None else self.pixels)
            seen = ModelViews(self.cameras or "auto", self.views or VIEWS, pixels, self.up)
        return render_findings(
            model, seen, background=behind, threads=self.threads, max_memory=self.max_memory,
            progress=progress,
        )  # fmt: skip
