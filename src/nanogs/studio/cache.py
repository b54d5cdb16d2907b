"""The state that the worker keeps: the scene as read, the filtered scene, and its forest."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from nanogs._types import Bool
from nanogs.filters import FilterReport, apply_with_mask
from nanogs.io import encoded_bytes, load, registry
from nanogs.pipeline.options.presets import PRESETS, renders
from nanogs.progress import Progress
from nanogs.splats import Splats
from nanogs.studio.choice import Choice, FilterChoice
from nanogs.studio.curve import Curve
from nanogs.studio.orders import filters_of
from nanogs.studio.scene import Scene, StudioSettings
from nanogs.studio.turning import direction_of

if TYPE_CHECKING:
    from nanogs.pipeline.grown import Grown

_SAMPLE = 4096  # splats of the sample file that is written to estimate bytes per splat
QUICKEST = "fast"  # the preset whose forest is grown the quickest
_CURVES = 32  # most curves that are kept

ModelKey: TypeAlias = tuple[str | None, FilterChoice]
GrownKey: TypeAlias = tuple[ModelKey, str, int | None, str | None]


def model_key(choice: Choice) -> ModelKey:
    """Return the cache key of a filtered model: its render mode and filters."""
    return choice.render_mode, choice.filters


def grown_key(choice: Choice) -> GrownKey:
    """Return the cache key of a forest: its model, preset, degree of harmonics and up direction."""
    return model_key(choice), choice.preset, choice.sh_degree, choice.up


@dataclass(frozen=True, slots=True)
class FilteredScene:
    """The scene after filtering.

    Attributes:
        splats: The remaining splats.
        stays: (N,) which of the scene's splats remain.
        reports: Number of splats that each filter removed.
    """

    splats: Splats
    stays: Bool
    reports: tuple[FilterReport, ...]


class WorkerCache:
    """A cache of one scene, one filtered scene, one forest, and the latest curves."""

    def __init__(self, scene: Scene, settings: StudioSettings) -> None:
        """Begin with an empty cache.

        Args:
            scene: The scene to read.
            settings: Settings of the studio.
        """
        self.scene, self.settings = scene, settings
        self._whole: tuple[str | None, Splats] | None = None
        self._sifted: tuple[ModelKey, FilteredScene] | None = None
        self.grown: tuple[GrownKey, Grown] | None = None
        self._curves: dict[tuple[GrownKey, str], Curve] = {}

    def whole(self, render_mode: str | None) -> Splats:
        """Return the unfiltered scene; it is read again if another render mode is asked for."""
        if self._whole is None or self._whole[0] != render_mode:
            self.forget()
            self._whole = render_mode, load(self.scene.path, render_mode=render_mode)
        return self._whole[1]

    def sifted(self, choice: Choice) -> FilteredScene:
        """Return the scene filtered by a choice, and keep it; the forest of another is dropped.

        Raises:
            ModelError: No splat is left.
        """
        key = model_key(choice)
        if self._sifted is None or self._sifted[0] != key:
            self._sifted, self.grown = (key, self.previewed(choice)), None
        return self._sifted[1]

    def previewed(self, choice: Choice) -> FilteredScene:
        """Return the scene filtered by a choice, without keeping it in the cache.

        Raises:
            ModelError: No splat is left.
        """
        if self._sifted is not None and self._sifted[0] == model_key(choice):
            return self._sifted[1]
        whole = self.whole(choice.render_mode)
        return FilteredScene(*apply_with_mask(whole, filters_of(choice.filters)))

    def here(self, choice: Choice) -> "Grown | None":
        """Return the forest in the cache if it is of the same model, of whatever preset."""
        if self.grown is None or self.grown[0][0] != model_key(choice):
            return None
        return self.grown[1]

    def roughly(self, choice: Choice, progress: Progress) -> "Grown":
        """Return a forest for drafts: the one in the cache if its model is the same, else `fast`'s.

        The preset `fast` renders nothing.

        Raises:
            NanogsError: It cannot be grown.
        """
        grown = self.here(choice)
        return grown or self.fully(replace(choice, preset=QUICKEST), progress)

    def fully(self, choice: Choice, progress: Progress) -> "Grown":
        """Return the forest of a choice, which is grown if it is not in the cache.

        Raises:
            NanogsError: It cannot be grown.
        """
        from nanogs.pipeline.grown import grow

        key = grown_key(choice)
        if self.grown is None or self.grown[0] != key:
            splats, chosen = self.sifted(choice).splats, PRESETS[choice.preset]
            up = direction_of(choice.up) if choice.up and renders(chosen) else None
            self.grown = None
            self.grown = key, grow(
                splats, preset=choice.preset, sh_degree=choice.sh_degree,
                up=up, device=self.settings.device, threads=self.settings.threads,
                max_memory=self.settings.max_memory, progress=progress,
            )  # fmt: skip
        return self.grown[1]

    def curve(self, choice: Choice, grown: "Grown") -> Curve:
        """Return the curve of a choice, with all results measured so far."""
        key = grown_key(choice), choice.format
        if key not in self._curves:
            for oldest in list(self._curves)[: 1 - _CURVES]:
                del self._curves[oldest]
            self._curves[key] = self._new_curve(choice, grown)
        return self._curves[key]

    def _new_curve(self, choice: Choice, grown: "Grown") -> Curve:
        suffix = ".sog" if choice.format == registry.META else choice.format
        known, splats = registry.writable(Path(f"model{suffix}")), self.sifted(choice).splats
        if choice.sh_degree is not None:
            splats = splats.with_sh_degree(choice.sh_degree)
        if (sizer := known.file_bytes) is not None:
            # Sizes follow from the columns; a copied row, so that the curve keeps no model alive.
            first = splats.take([0])
            return Curve(grown.available, grown.fewest, lambda n: sizer(first, n), exact=True)
        every = -(-len(splats) // _SAMPLE)
        some = splats.take(slice(None, None, every))
        share = encoded_bytes(some, Path(f"model{suffix}")) / len(some)
        return Curve(grown.available, grown.fewest, lambda n: round(share * n), exact=False)

    def is_grown(self, choice: Choice) -> bool:
        """Return whether the forest in the cache is that of a choice."""
        return self.grown is not None and self.grown[0] == grown_key(choice)

    def forget(self) -> None:
        """Free the scene and the forest, which are read and grown again when needed."""
        self._whole = self._sifted = self.grown = None
