"""A choice translated to arguments of a library function, and to the equivalent command line."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nanogs import filters
from nanogs.errors import OptionError
from nanogs.formatting import counted, exact_text
from nanogs.io import check_writable, registry
from nanogs.levels_of_detail import sink_of
from nanogs.lod.layout import Output, block_layout_of, output_of
from nanogs.pipeline.options.presets import DEFAULT_PRESET, PRESETS, renders
from nanogs.pipeline.options.target import Goal
from nanogs.pipeline.request import Request
from nanogs.studio.choice import Choice, FilterChoice
from nanogs.studio.scene import Scene, StudioSettings
from nanogs.studio.turning import direction_of, frames_to, turned

LAYOUTS = {
    registry.LEVELS: ("streamed SOG, a folder", "{stem}/lod-meta.json"),
    registry.ARCHIVE: ("streamed SOG, one file", "{stem}.ssog"),
    registry.TILESET: ("3D Tiles, a folder", "{stem}/tileset.json"),
    ".rad": ("a tree for Spark, one file", "{stem}.rad"),
}
"""Layouts of levels of detail, by suffix: a description, and a template of the output path."""


@dataclass(frozen=True, slots=True)
class SaveRequest:
    """A request to write a file, or levels of detail, for a choice.

    Attributes:
        scene: The scene.
        settings: Settings of the studio.
        choice: The user's choice.
        path: The output file, or the file that describes levels, as the user would type it.
        overwrite: Whether an existing output may be replaced.

    Raises:
        OptionError: Parts of the choice contradict each other, the scene or the path.
    """

    scene: Scene
    settings: StudioSettings
    choice: Choice
    path: Path
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Raise for combinations that the command would refuse, too."""
        refuse_unfit(self.scene, self.choice)
        known = self.choice.format.lower()
        if not self.path.name.lower().endswith(known):
            raise OptionError(
                f"{self.path} is not the name of a {known} file; let it end in {known}."
            )
        found = registry.find(self.path)
        if found is None or found.suffix != known:
            raise OptionError(f"{self.path} is not the name of a {known} file; name another one.")
        if self.choice.levels is not None:
            self.output  # noqa: B018 - raises if the name is not one of a layout of levels

    @property
    def output(self) -> Output:
        """Folder and layout of the levels, as the path names them."""
        return output_of(self.path)

    @property
    def target(self) -> Path:
        """The file to write, or the folder for levels in a folder."""
        return self.path if self.choice.levels is None else self.output.folder

    @property
    def frames(self) -> tuple[str, str] | None:
        """Source and target frame to turn the file from and to; None to leave it unturned.

        The target is empty if the format has a frame of its own.
        """
        choice = self.choice
        if choice.up is None or choice.up == self.scene.up:
            return None
        return frames_to(choice.up, self.path if choice.levels is None else self.output.model)

    @property
    def _looks(self) -> bool:
        return renders(PRESETS[self.choice.preset])

    def check_target(self) -> None:
        """Raise, before anything is computed, if the output cannot be written.

        Raises:
            OutputError: It exists and may not be replaced, or it cannot be written.
        """
        if self.choice.levels is None:
            check_writable(self.path, overwrite=self.overwrite)
            return
        output, finest = self.output, Goal(ratio=self.choice.levels[0])
        block_layout = block_layout_of(output.layout, None, plain=False)
        request = Request(
            goal=finest, output=output.folder, overwrite=self.overwrite, block_layout=block_layout,
            ratios=self.choice.levels, level_suffix=output.suffix,
        )  # fmt: skip
        sink_of(request, layout=output.layout).check()

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments for `simplify_blocks`, or for `write_levels`."""
        choice, settings, direction = self.choice, self.settings, None
        if choice.up is not None and self._looks:
            direction = direction_of(choice.up)
        shared: dict[str, Any] = {
            "preset": choice.preset, "sh_degree": choice.sh_degree, "measured": None,
            "filters": filters_of(choice.filters), "render_mode": choice.render_mode,
            "up": direction, "frame": turned(self.frames), "overwrite": self.overwrite,
            "threads": settings.threads, "max_memory": settings.max_memory,
            "device": settings.device,
        }  # fmt: skip
        if choice.levels is None:
            goal = choice.goal
            wish = {"count": goal.count, "size": goal.size, "psnr": goal.psnr}
            return {"inputs": self.scene.path, "output": self.path} | wish | shared
        output = self.output
        return shared | {
            "model": self.scene.path, "folder": output.folder, "ratios": choice.levels,
            "layout": output.layout, "suffix": output.suffix,
        }  # fmt: skip

    def words(self) -> list[str]:
        """Return the words of the command line that writes the same output."""
        choice, goal = self.choice, self.choice.goal
        levels = choice.levels
        wish: dict[str, object] = {"count": goal.count, "size": goal.size, "psnr": goal.psnr}
        if levels is not None:
            wish = {"levels": ",".join(map(exact_text, levels))}
        named = wish | {
            "preset": None if choice.preset == DEFAULT_PRESET else choice.preset,
            "sh-degree": choice.sh_degree,
            "crop": choice.filters.box and "box:" + ",".join(map(exact_text, choice.filters.box)),
            "min-opacity": choice.filters.min_opacity,
            "drop-floaters": choice.filters.floaters or None,
            "render-mode": choice.render_mode,
            "up": choice.up and self._looks and ",".join(map(exact_text, direction_of(choice.up))),
            "frame": self.frames and ":".join(self.frames),
            "device": None if self.settings.device == "cpu" else self.settings.device,
            "max-memory": self.settings.max_memory,
            "overwrite": self.overwrite or None,
        }
        command = "simplify" if levels is None else "lod"
        paths = [typed(self.scene.path), typed(self.path)]
        options = [word for name, value in named.items() for word in option(name, value)]
        return ["nanogs", command, *paths, *options]

    def command(self) -> str:
        """Return the same command as one line, quoted for a shell."""
        return shlex.join(self.words())


def refuse_unfit(scene: Scene, choice: Choice) -> None:
    """Raise if a choice is not possible for a scene, as far as can be seen from its header.

    Raises:
        OptionError: It is not possible.
    """
    goal, count = choice.goal, choice.goal.count
    if choice.levels is None and choice.format in LAYOUTS and choice.format != ".rad":
        raise OptionError(f"{choice.format} needs levels of detail; give their ratios.")
    if choice.levels is not None and choice.format not in LAYOUTS:
        raise OptionError(f"Levels are written as {', '.join(LAYOUTS)}, not as {choice.format}.")
    if choice.levels is None:
        known = registry.writable(Path(f"model{choice.format}"))
        if known.write is None and count is None:
            raise OptionError(
                f"A file size or a PSNR is possible only for one file, and {known.suffix} describes"
                " a folder; set the count, or choose .sog."
            )
    if choice.levels is None and count is not None and count > scene.splats:
        raise OptionError(
            f"The count {count:,} is above the {counted(scene.splats, 'splat')} of the scene."
        )
    if (
        goal.psnr is not None
        and choice.sh_degree is not None
        and not renders(PRESETS[choice.preset])
    ):
        raise OptionError(
            "A PSNR cannot be chosen with a lower SH degree and this preset, because it is"
            " measured against the whole model; choose the preset default or best, or set the"
            " count or the file size."
        )
    if choice.up is not None and choice.up != scene.up and scene.states_frame:
        raise OptionError(
            f"The up direction cannot be changed, because {scene.path.name} states its frame; save"
            " it without the change, or convert it to .ply first and open that."
        )


def filters_of(chosen: FilterChoice) -> list[filters.Filter]:
    """Return the filters of a choice, in the order in which the command applies them."""
    regions = [] if chosen.box is None else [filters.box(chosen.box[:3], chosen.box[3:])]
    return filters.in_order(regions, chosen.min_opacity, floaters=chosen.floaters)


def typed(path: Path) -> str:
    """Format a path so that a command does not take it for an option."""
    text = str(path)
    return f"./{text}" if text.startswith("-") else text


def option(name: str, value: object) -> list[str]:
    """Return the words of an option: none without a value, one for a flag, else name and value."""
    if value is None or value is False or value == "":
        return []
    if value is True:
        return [f"--{name}"]
    return [f"--{name}", exact_text(value) if isinstance(value, float) else str(value)]


def shown_path(scene: Scene, choice: Choice) -> Path:
    """Return a placeholder output path, for showing the command before the user names a file."""
    if choice.levels is not None:
        return Path(LAYOUTS[choice.format][1].format(stem=f"{scene.stem}-levels"))
    folder = choice.format == registry.META
    return Path("out") / choice.format if folder else Path(f"out{choice.format}")
