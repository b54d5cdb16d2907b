"""The scene of a studio, as its file header describes it, and the settings of the studio."""

from dataclasses import dataclass
from pathlib import Path

from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.formatting import bytes_text
from nanogs.io import open as open_model
from nanogs.io import registry
from nanogs.io.url_files import refuse_address
from nanogs.memory import LIBRARIES, allowed_memory
from nanogs.pipeline.estimates.memory import plan_memory
from nanogs.pipeline.options.presets import DEFAULT_PRESET, FORESTS, PRESETS
from nanogs.studio.turning import stated_up, states_frame


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """The scene as the header of its file describes it.

    Attributes:
        path: The file, as the user named it.
        splats: Number of splats.
        sh_degree: Degree of their spherical harmonics.
        file_bytes: Size of the file.
        render_mode: Render mode that the file states.
        up: Up axis that the file or its format states, such as "-y", or None.
        states_frame: Whether the file itself states its frame, which then cannot be changed.
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
        """File name without the suffix."""
        return registry.stem_of(self.path)


@dataclass(frozen=True, slots=True, kw_only=True)
class StudioSettings:
    """Settings of a studio: the initial options of its page, and the resources to use.

    Attributes:
        preset: Initial preset.
        render_mode: Initial render mode, or None for the one that the file states.
        up: Initial up axis, or None to find it.
        threads: Number of threads; None for all.
        max_memory: Bytes that the process may take; None for what is free.
        device: Device on which views are rendered.
    """

    preset: str = DEFAULT_PRESET
    render_mode: str | None = None
    up: str | None = None
    threads: int | None = None
    max_memory: int | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Raise for a preset that cannot make any count quickly, because it grows no forest."""
        if self.preset not in FORESTS:
            raise OptionError(
                f"The studio has the presets {', '.join(FORESTS)}, not {self.preset!r}; choose one"
                " of these."
            )


def scene_of(path: Path) -> Scene:
    """Read the header of a model.

    Raises:
        FormatError: It cannot be read.
        OptionError: It is a URL, or holds no splats.
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


def refuse_small_memory(scene: Scene, settings: StudioSettings) -> None:
    """Raise if the memory allowed does not even hold the model, so that no result can be made.

    Raises:
        NotEnoughMemoryError: `max_memory` is too small.
    """
    if settings.max_memory is None:
        return
    plan = plan_memory(
        scene.splats, scene.sh_degree, 0, PRESETS[settings.preset], scene.splats, judged=True
    )
    allowed = allowed_memory(settings.max_memory)
    if plan.input_columns > allowed.bytes:
        raise NotEnoughMemoryError(
            f"{scene.path} takes about {bytes_text(plan.peak + LIBRARIES)} of memory in the studio,"
            " Python and its libraries included; raise `max_memory`, or leave it out."
        )
