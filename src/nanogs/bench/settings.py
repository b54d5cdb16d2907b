"""The settings of a run, what to measure and how: checked before anything is computed."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from nanogs.bench.methods import all_methods, find_method
from nanogs.bench.rows import ORIGINAL
from nanogs.errors import OptionError
from nanogs.protocol import Background
from nanogs.views.cameras import FOUND

RATIOS = (0.1, 0.01, 0.001)


@dataclass(frozen=True, slots=True)
class BenchSettings:
    """The protocol's parameters.

    Attributes:
        ratios: Compaction ratios in (0, 1].
        methods: Names as `nanogs.bench.methods` takes them.
        externals: Patterns of files that other tools made, by name; {scene}, {ratio} and {model}
            (the model's file name up to the first dot) in them are replaced. A JSON file of the
            same name and .json behind it may hold `seconds` and `peak_memory` (bytes).
        views: Views of each kind for scenes without photographs; as many as usual by default.
        sizes: Their widths, which are their heights, pixels.
        kinds: Their arrangements, names in `render.source.FOUND`.
        fit_views: Automatic views to learn from, for baselines that do. Presets look from views
            of their own, as they do without a bench.
        background: RGB in [0, 1] behind photographs and what is held against them; None for the
            data set's own (see `Dataset.background`).
        metrics: Further metrics: "lpips", "flip".
        seed: Seed of whatever methods draw.
        threads: Threads to use; None for all.

    Raises:
        OptionError: A value is out of range, or a name unknown or given twice.
    """

    ratios: tuple[float, ...] = RATIOS
    methods: tuple[str, ...] = field(default_factory=all_methods)
    externals: Mapping[str, str] = field(default_factory=dict)
    views: int | None = None
    sizes: tuple[int, ...] = (512,)
    kinds: tuple[str, ...] = ("auto",)
    fit_views: int = 40
    background: Background | None = None
    metrics: tuple[str, ...] = ()
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        for ratio in self.ratios:
            if not 0 < ratio <= 1:
                raise OptionError(f"A ratio must be above 0 and at most 1, not {ratio:g}.")
        for name, value in (("views", self.views), ("fit_views", self.fit_views)):
            if value is not None and value < 1:
                raise OptionError(f"{name} must be at least 1, not {value}.")
        for size in self.sizes:
            if size < 16:
                raise OptionError(f"The size of a view must be at least 16 pixels, not {size}.")
        for kind in self.kinds:
            if kind not in FOUND:
                raise OptionError(f"Views are {', '.join(FOUND)}, not {kind!r}.")
        if not self.sizes or not self.kinds:
            raise OptionError("Give at least one size and one kind of views.")
        refuse_twins("size", [str(size) for size in self.sizes])
        refuse_twins("kind", list(self.kinds))
        if not self.ratios or not (self.methods or self.externals):
            raise OptionError("Give at least one ratio and one method.")
        refuse_twins("ratio", [f"{ratio:g}" for ratio in self.ratios])
        refuse_twins("method", [ORIGINAL, *self.methods, *self.externals])
        for method in self.methods:
            find_method(method)


def refuse_twins(what: str, names: list[str]) -> None:
    """Names must differ: rows of the same name could not be told apart.

    Raises:
        OptionError: Two are the same.
    """
    for index, name in enumerate(names):
        if name in names[:index]:
            raise OptionError(f"There are two of the {what} {name!r}; give each a name of its own.")
