"""The file that a studio is of, and how the studio was started. Only the header is read."""

from dataclasses import dataclass
from pathlib import Path

from nanogs.errors import OptionError
from nanogs.io import open as open_model
from nanogs.io import registry
from nanogs.io.stand_ins import refuse_address
from nanogs.pipeline.presets import DEFAULT_PRESET
from nanogs.studio.choice import PRESETS
from nanogs.studio.turning import stated_up, states_frame


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """The scene as the header of its file describes it.

    Attributes:
        path: The file, as it was named.
        splats: How many it holds.
        sh_degree: Of their harmonics.
        file_bytes: Its size.
        render_mode: What it says it is to be drawn as.
        up: The axis that it says is up, such as "-y", or None.
        states_frame: Whether it states its frame, so that nobody may say another.
    """

    path: Path
    splats: int
    sh_degree: int
    file_bytes: int
    render_mode: str
    up: str | None
    states_frame: bool

    @property
    def stem(self) -> str:
        """Its name without the suffix."""
        return registry.stem_of(self.path)


@dataclass(frozen=True, slots=True, kw_only=True)
class Manner:
    """How all work of a studio is done, and what its page begins with.

    Attributes:
        preset: The one that the page begins with.
        render_mode: What the model is drawn as at first, or None for what its file says.
        up: The axis that is up at first, or None for what is found.
        threads: To use; None for all.
        max_memory: Bytes that the process may take; None for what is free.
        device: Where pictures are made.
    """

    preset: str = DEFAULT_PRESET
    render_mode: str | None = None
    up: str | None = None
    threads: int | None = None
    max_memory: int | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse a preset that answers no count in a moment."""
        if self.preset not in PRESETS:
            raise OptionError(
                f"The studio has the presets {', '.join(PRESETS)}, not {self.preset!r}; choose one"
                " of these."
            )


def scene_of(path: Path) -> Scene:
    """Read the header of a model.

    Raises:
        FormatError: It cannot be read.
        OptionError: It is a URL, or without splats.
    """
    refuse_address(path, "download it first and name the file")
    with open_model(path) as source:
        info = source.info
        if not info.splats:
            raise OptionError(f"{path} holds no splats; name another model.")
        return Scene(
            path=path, splats=info.splats, sh_degree=info.sh_degree, file_bytes=info.file_bytes,
            render_mode=str(info.render_mode), up=stated_up(source, path),
            states_frame=states_frame(source, path),
        )  # fmt: skip
