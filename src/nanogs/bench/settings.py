"""What to measure, and how: checked before anything is computed."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from nanogs.bench.methods import all_methods, find_method
from nanogs.bench.rows import ORIGINAL
from nanogs.compare.protocol import Background
from nanogs.errors import OptionError

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
        views: Automatic views for scenes without photographs.
        size: Their width and height, pixels.
        camera_kind: Their arrangement, as `automatic_cameras` takes it.
        fit_views: Automatic views to learn from, for methods that do.
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
    views: int = 8
    size: int = 512
    camera_kind: Literal["auto", "orbit", "inside"] = "auto"
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
            if value < 1:
                raise OptionError(f"{name} must be at least 1, not {value}.")
        if self.size < 16:
            raise OptionError(f"The size of a view must be at least 16 pixels, not {self.size}.")
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
