"""The settings of a run: what is measured and how, checked before anything is computed."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from nanogs.bench.methods import all_methods, find_method, refuse_unsized
from nanogs.bench.rows import ORIGINAL, BenchTarget, size_name
from nanogs.defaults import BENCH_RATIOS
from nanogs.errors import OptionError
from nanogs.io import registry
from nanogs.io.retag import checked_mode
from nanogs.protocol import Background
from nanogs.views.cameras import FOUND


@dataclass(frozen=True, slots=True)
class BenchSettings:
    """The settings of a run.

    Attributes:
        ratios: Compaction ratios in (0, 1]; not used if there are file sizes.
        methods: Names of methods; see `nanogs.bench.methods`.
        externals: Patterns of files that other tools made, by name; {scene}, {ratio} and {model}
            (the model's file name up to the first dot) in them are replaced. A JSON file of the
            same name with .json appended may hold `seconds` and `peak_memory` (bytes). With file
            sizes, {size}, like 0.5MB, and {format}, like sog, replace {ratio}.
        views: Number of views of each kind for scenes without photographs; None for the kind's
            usual number (`nanogs.protocol.usual_views`).
        sizes: Their widths, which are their heights, pixels.
        kinds: Their arrangements, names in `nanogs.views.cameras.FOUND`.
        fit_views: Number of automatic views for baselines that learn from views. Presets find
            views of their own, as they do without a bench.
        background: RGB in [0, 1] behind photographs and the renders compared with them; None for
            the data set's own (see `Dataset.background`).
        metrics: Further metrics: "lpips", "flip".
        seed: Seed of the methods' random numbers.
        threads: Threads to use; None for all.
        file_sizes: Sizes, bytes, of the files that presets make instead of models of a ratio.
        formats: Suffixes of these files.
        render_mode: "default" or "mip", which overrides the render mode of the files of models and
            of results; see `nanogs.load`.

    Raises:
        OptionError: A value is out of range, or a name unknown or given twice.
    """

    ratios: tuple[float, ...] = BENCH_RATIOS
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
    file_sizes: tuple[int, ...] = ()
    formats: tuple[str, ...] = (".sog",)
    render_mode: str | None = None

    @property
    def targets(self) -> tuple[BenchTarget, ...]:
        """The requests to every method: ratios, or file sizes by format and ascending size."""
        if not self.file_sizes:
            return tuple(BenchTarget(ratio) for ratio in self.ratios)
        sizes = sorted(self.file_sizes)
        return tuple(BenchTarget(None, suffix, size) for suffix in self.formats for size in sizes)

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        self._check_names()
        self._check_files()
        checked_mode(self.render_mode)
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
                raise OptionError(f"Views must be {', '.join(FOUND)}, not {kind!r}.")
        if not self.sizes or not self.kinds:
            raise OptionError("Give at least one size and one kind of views.")
        refuse_duplicates("size", [str(size) for size in self.sizes])
        refuse_duplicates("kind", list(self.kinds))
        if not self.ratios or not (self.methods or self.externals):
            raise OptionError("Give at least one ratio and one method.")
        refuse_duplicates("ratio", [f"{ratio:g}" for ratio in self.ratios])
        refuse_duplicates("method", [ORIGINAL, *self.methods, *self.externals])
        for method in self.methods:
            find_method(method)

    def _check_names(self) -> None:
        """Refuse other tools that are named among the methods too."""
        for method in self.methods:
            if method in self.externals and method.partition(":")[0] not in all_methods():
                raise OptionError(
                    f"{method!r} is measured as the result of another tool already; leave it out of"
                    " the methods, which are those that nanogs runs."
                )

    def _check_files(self) -> None:
        """Refuse file sizes and formats that are invalid, and methods that cannot meet a size."""
        if not self.file_sizes:
            return
        for size in self.file_sizes:
            if size < 1:
                raise OptionError(f"The size of a file must be at least 1 byte, not {size}.")
        refuse_duplicates("size", [size_name(size) for size in self.file_sizes])
        refuse_duplicates("format", list(self.formats))
        for suffix in self.formats:
            _refuse_format(suffix)
            for method in self.methods:
                refuse_unsized(method, suffix)
        for name, pattern in self.externals.items():
            if len(self.formats) > 1 and "{format}" not in pattern:
                raise OptionError(
                    f"The files of {name} need {{format}} in {pattern!r}, as several"
                    " formats are asked for."
                )


def _refuse_format(suffix: str) -> None:
    """Refuse a format that nanogs cannot write as one file and read again.

    Raises:
        OptionError: It is such a format, or unknown.
    """
    known = registry.writable(registry.file_of(suffix))
    if known.write is None or not known.readable or known.suffix != suffix:
        raise OptionError(
            f"{suffix} is not a format of single files that nanogs both writes and reads."
        )


def refuse_duplicates(what: str, names: list[str]) -> None:
    """Refuse duplicate names, because their rows could not be distinguished.

    Raises:
        OptionError: Two names are the same.
    """
    for index, name in enumerate(names):
        if name in names[:index]:
            raise OptionError(
                f"The {what} {name!r} occurs twice; leave one out, or name it differently."
            )
