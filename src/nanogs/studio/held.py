"""The state of the worker: the scene as read, what filters leave of it, and its forest."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from nanogs._types import Bool
from nanogs.filters import FilterReport, sift
from nanogs.io import encoded_bytes, load, registry
from nanogs.pipeline.cameras import requested_cameras
from nanogs.pipeline.presets import PRESETS, renders
from nanogs.progress import Progress
from nanogs.splats import Splats
from nanogs.studio.choice import Choice, Sifting
from nanogs.studio.curve import Curve
from nanogs.studio.orders import filters_of
from nanogs.studio.scene import Manner, Scene
from nanogs.studio.turning import direction_of

if TYPE_CHECKING:
    from nanogs.pipeline.grown import Grown
    from nanogs.raster.camera import Camera

_SAMPLE = 4096  # splats, of which a file is written to see how large one is
QUICKEST = "fast"  # the preset whose forest is there first
_CURVES = 32  # that are kept

ModelKey: TypeAlias = tuple[str | None, Sifting]
GrownKey: TypeAlias = tuple[ModelKey, str, int | None, str | None]


def model_key(choice: Choice) -> ModelKey:
    """Key of a model: how it is drawn, and the filters."""
    return choice.render_mode, choice.filters


def grown_key(choice: Choice) -> GrownKey:
    """Key of a forest: its model, preset, degree of harmonics and up direction."""
    return model_key(choice), choice.preset, choice.sh_degree, choice.up


@dataclass(frozen=True, slots=True)
class Sifted:
    """The model that filters leave of the scene.

    Attributes:
        splats: The model.
        stays: (N,) of the scene's splats, which stay.
        reports: What each filter took.
    """

    splats: Splats
    stays: Bool
    reports: tuple[FilterReport, ...]


class Held:
    """One scene, one forest, and curves of those that were asked for lately."""

    def __init__(self, scene: Scene, manner: Manner) -> None:
        """Hold nothing yet.

        Args:
            scene: The file.
            manner: How work is done.
        """
        self.scene, self.manner = scene, manner
        self._whole: tuple[str | None, Splats] | None = None
        self._sifted: tuple[ModelKey, Sifted] | None = None
        self.grown: tuple[GrownKey, Grown] | None = None
        self._curves: dict[tuple[GrownKey, str], Curve] = {}

    def whole(self, render_mode: str | None) -> Splats:
        """The scene, read again where it is to be drawn in another way."""
        if self._whole is None or self._whole[0] != render_mode:
            self.forget()
            self._whole = render_mode, load(self.scene.path, render_mode=render_mode)
        return self._whole[1]

    def sifted(self, choice: Choice) -> Sifted:
        """Filter the scene as a choice says, and make the result the present model.

        Raises:
            ModelError: Nothing.
        """
        key = model_key(choice)
        if self._sifted is None or self._sifted[0] != key:
            whole = self.whole(choice.render_mode)
            found = Sifted(*sift(whole, filters_of(choice.filters)))
            self._sifted, self.grown = (key, found), None
        return self._sifted[1]

    def previewed(self, choice: Choice) -> Sifted:
        """Filter the scene as a choice says, while the present model stays the present one.

        Raises:
            ModelError: Nothing.
        """
        if self.is_shown(choice):
            return self.sifted(choice)
        return Sifted(*sift(self.whole(choice.render_mode), filters_of(choice.filters)))

    def is_shown(self, choice: Choice) -> bool:
        """Whether the model of a choice is the present one."""
        return self._sifted is not None and self._sifted[0] == model_key(choice)

    def here(self, choice: Choice) -> "Grown | None":
        """The forest that is there, if it is of the same model; of another preset perhaps."""
        if self.grown is None or self.grown[0][0] != model_key(choice):
            return None
        return self.grown[1]

    def roughly(self, choice: Choice, progress: Progress) -> "Grown":
        """A forest for drafts: one of the same model that is there, else one that looks at nothing.

        Raises:
            NanogsError: It cannot be grown.
        """
        grown = self.here(choice)
        return grown or self.fully(replace(choice, preset=QUICKEST), progress)

    def fully(self, choice: Choice, progress: Progress) -> "Grown":
        """The forest of a choice, grown if it is not there.

        Raises:
            NanogsError: It cannot be.
        """
        from nanogs.pipeline.grown import grow

        key = grown_key(choice)
        if self.grown is None or self.grown[0] != key:
            splats = self.sifted(choice).splats
            self.grown = None
            self.grown = key, grow(
                splats, preset=choice.preset, sh_degree=choice.sh_degree,
                cameras=_cameras(splats, choice), device=self.manner.device,
                threads=self.manner.threads, max_memory=self.manner.max_memory, progress=progress,
            )  # fmt: skip
        return self.grown[1]

    def curve(self, choice: Choice, grown: "Grown") -> Curve:
        """The curve of a choice, with all that is known of its results."""
        key = grown_key(choice), choice.format
        if key not in self._curves:
            for oldest in list(self._curves)[: 1 - _CURVES]:
                del self._curves[oldest]
            self._curves[key] = self._new_curve(choice, grown)
        return self._curves[key]

    def _new_curve(self, choice: Choice, grown: "Grown") -> Curve:
        suffix = ".sog" if choice.format == "meta.json" else choice.format
        known, splats = registry.writable(Path(f"model{suffix}")), self.sifted(choice).splats
        if choice.sh_degree is not None:
            splats = splats.with_sh_degree(choice.sh_degree)
        if (sizer := known.file_bytes) is not None:
            return Curve(grown.available, grown.fewest, lambda n: sizer(splats, n), exact=True)
        every = -(-len(splats) // _SAMPLE)
        some = splats.take(slice(None, None, every))
        share = encoded_bytes(some, Path(f"model{suffix}")) / len(some)
        return Curve(grown.available, grown.fewest, lambda n: round(share * n), exact=False)

    def is_grown(self, choice: Choice) -> bool:
        """Whether the forest of a choice is there."""
        return self.grown is not None and self.grown[0] == grown_key(choice)

    def forget(self) -> None:
        """Let go of everything; it is read and grown again when it is needed."""
        self._whole = self._sifted = self.grown = None


def _cameras(splats: Splats, choice: Choice) -> "list[Camera] | None":
    """The views that a choice of what is up leads to; None where the preset finds its own."""
    chosen = PRESETS[choice.preset]
    if choice.up is None or not renders(chosen):
        return None
    return requested_cameras(splats, "auto", direction_of(choice.up), chosen)
