"""The result that fills a size: how it is packed, then how many splats it has."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from nanogs.errors import TooSmallError
from nanogs.io.format import Format
from nanogs.pipeline.fit_size import Fitted, fit_size, guess_count, too_small
from nanogs.pipeline.packing import (
    SMALLER,
    Bits,
    Choices,
    Look,
    Packing,
    Try,
    choose_packing,
    slope_of,
)
from nanogs.pipeline.results import Results
from nanogs.pipeline.target import count_for_size
from nanogs.pipeline.weights import PACKINGS
from nanogs.progress import Stage, Tracker
from nanogs.report import PackingReport
from nanogs.splats import Splats

T = TypeVar("T")
R_contra = TypeVar("R_contra", contravariant=True)
PALETTE, SH_BITS = "palette", "sh_bits"
CUTS = 0.5, 0.8  # of the count that fills a size, of plain cuts that tell what more splats bring
FEW = 8  # times the fewest splats: more of the model's own hide that these would not fit
Options = Mapping[str, Any]


class Files(Protocol[R_contra]):
    """Writes results to see how large their files are, and what these show."""

    def count(self, result: R_contra) -> int:
        """Splats of a result."""

    def sample_bytes(self, some: Splats, options: Options) -> int:
        """Bytes of a file of some splats, with options of the format."""

    def bytes_of(self, result: R_contra, options: Options) -> int:
        """Bytes of a result's file."""

    def seen(self, result: R_contra, sh_degree: int, options: Options) -> tuple[int, float, float]:
        """Bytes of a result's file, and its PSNR and SSIM on views by which is chosen.

        Args:
            result: The result.
            sh_degree: Of the harmonics that are written, as far as it has them.
            options: Of the format.
        """


class Wish(NamedTuple):
    """What is asked of a file, besides what can be chosen.

    Attributes:
        size: Bytes that it may have.
        known: Its format.
        given: Options of it.
        sh_degree: Of the harmonics that are to be written, or None to choose it.
        by_psnr: Whether the PSNR alone says what is best.
        looks: Whether what is not asked for may be chosen, as by presets that render.
    """

    size: int
    known: Format
    given: Options
    sh_degree: int | None = None
    by_psnr: bool = False
    looks: bool = True

    def choices(self, degree: int) -> Choices:
        """What it leaves to be chosen, of a model with harmonics of a degree."""
        highest = min(degree, self.known.max_degree)
        fixed = None if self.sh_degree is None else [min(self.sh_degree, highest)]
        if not (self.looks and self.known.readable):
            return Choices(fixed or [highest], palettes=False)
        bits = {
            name: Bits(option.usual, option.values)
            for name, option in self.known.options.items()
            if option.usual is not None and name not in self.given
        }
        if not highest:
            bits.pop(SH_BITS, None)
        palettes = PALETTE in self.known.options and PALETTE not in self.given
        return Choices(fixed or range(highest + 1), palettes, bits, self.by_psnr)

    def share(self, packing: Packing, count: int) -> float | None:
        """Splats for an entry of the palette, of a result of so many; None without one."""
        if PALETTE in self.given and packing.sh_degree:
            return max(count / int(self.given[PALETTE]), 1.0)
        return packing.share_of(count)

    def smallest(self, degree: int) -> Packing:
        """The packing of the smallest files, of a model with harmonics of a degree."""
        choices = self.choices(degree)
        share = SMALLER[-1] if choices.first.share else None
        bits = tuple((name, each.values[0]) for name, each in choices.bits.items())
        return Packing(choices.degrees[0], share, bits)


@dataclass(frozen=True, slots=True)
class Packed:
    """How results are packed, chosen by looking.

    Attributes:
        packing: The best.
        count: Splats that about fill the size with it.
        packings: What was tried.
        highest: Degree of the harmonics that there might be.
        tight: Whether nothing fits that is not packed as small as may be.
    """

    packing: Packing
    count: int
    packings: tuple[PackingReport, ...]
    highest: int
    tight: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence where harmonics were left out that might have been kept."""
        kept = self.packing.sh_degree
        why = "nothing else fits" if self.tight else "so the file shows more"
        left = f"Spherical harmonics above degree {kept} are left out: {why}."
        return (left,) if kept < self.highest else ()


class Filled(NamedTuple):
    """The search for a result that fills a size.

    Attributes:
        fitted: The counts that were tried.
        packed: As it is packed.
    """

    fitted: Fitted
    packed: Packed


def pack(
    results: Results[T], wish: Wish, sample: Splats, files: Files[T], progress: Tracker
) -> Packed:
    """Choose how results are packed.

    Args:
        results: Of the model.
        wish: What is asked of the file.
        sample: Some usable splats of the model.
        files: Writes results.
        progress: Told of each stage.
    """
    guess = partial(_guess, results, wish, sample, files)
    choices = wish.choices(sample.sh_degree)
    progress.begin("guess")
    if not results.looks or not choices.any:
        packing = replace(choices.first, share=None)
        return Packed(packing, guess(packing), (), packing.sh_degree)
    progress.begin("pack")
    attempt = _attempts(results, wish, files, progress)
    slope = _slope(results, choices, guess(choices.first), files, progress)
    chosen = choose_packing(choices, wish.size, slope, guess, attempt, results.available)
    return Packed(*chosen, choices.degrees[-1])


def _slope(
    results: Results[T], choices: Choices, count: int, files: Files[T], progress: Tracker
) -> float:
    """What more splats bring, by two plain cuts, whose palettes hide nothing of it."""
    packing, plain = replace(choices.first, share=None), results.plain(rounds=0)

    def shown(part: int, share: float) -> PackingReport:
        some = min(max(round(share * count), results.fewest), results.available)
        within = progress.within(part, PACKINGS, plain.stages(some))
        _, found = plain.marked(some, lambda one: asdict(_seen(files, one, packing)), within)
        return PackingReport(**found)

    less, more = (shown(part, share) for part, share in enumerate(CUTS))
    return slope_of(choices, less, more)


@dataclass(eq=False)
class PackNear(Generic[T]):
    """Chooses how results that reach a PSNR are packed, once it is known about how large they are.

    Attributes:
        results: Of the model.
        wish: What is asked of the file; its size does not count.
        sample: Some usable splats of the model.
        files: Writes results.
        progress: Told of each stage.
        packed: What was chosen; None until then, and where results stay as they are.
    """

    results: Results[T]
    wish: Wish
    sample: Callable[[], Splats]
    files: Files[T]
    progress: Tracker
    packed: Packed | None = None

    def __call__(self, count: int) -> tuple[Results[T], int]:
        """Results that are packed best in files about as large as a plain cut of a count has.

        Args:
            count: Splats of the plain cut.

        Returns:
            The results, and a count of about the same size.
        """
        if self.wish.known.file_bytes is not None:  # fewer splats are what makes it smaller
            return self.results, count
        self.progress.begin("guess")
        plain = self.results.plain(rounds=0)
        within = self.progress.within(0, 1, plain.stages(count))
        _, size = plain.marked(count, partial(self.files.bytes_of, options={}), within)
        wish = self.wish._replace(size=size, by_psnr=True)
        packed = pack(self.results, wish, self.sample(), self.files, self.progress)
        self.packed = packed if packed.packings else None
        share = wish.share(packed.packing, packed.count)
        return self.results.packed(packed.packing.sh_degree, share), packed.count

    def options(self, result: T) -> dict[str, Any]:
        """Options of the format that a result is packed with."""
        return self.packed.packing.options(self.files.count(result)) if self.packed else {}

    def entries(self, result: T) -> dict[str, Any]:
        """What the report has of it."""
        tried = self.packed.packings if self.packed else ()
        return {"packings": tried, "format_options": self.options(result)}

    @property
    def notes(self) -> tuple[str, ...]:
        """As `Packed` has them."""
        return self.packed.notes if self.packed else ()


def fill_size(
    results: Results[T], wish: Wish, sample: Splats, files: Files[T], progress: Tracker
) -> tuple[T, Filled]:
    """The result of a model that is packed best and fills a size.

    Args:
        results: Of the model.
        wish: What is asked of the file.
        sample: Some usable splats of the model.
        files: Writes results.
        progress: Told of each stage.

    Returns:
        The result, and what was tried.

    Raises:
        TooSmallError: Not even the fewest splats fit.
    """
    smallest = _smallest(results, wish, sample, files, progress)
    packed = pack(results, wish, sample, files, progress)
    try:
        return _filled(results, wish, sample, files, packed, progress)
    except TooSmallError:
        packed = replace(packed, packing=smallest, count=results.fewest, tight=True)
    return _filled(results, wish, sample, files, packed, progress)


def _guess(
    results: Results[T], wish: Wish, sample: Splats, files: Files[T], packing: Packing
) -> int:
    """The count of the model's own splats that fill the size with a packing, about."""
    some = sample.with_sh_degree(packing.sh_degree)
    if (known := wish.known.file_bytes) is not None:
        if known(some, 1) > wish.size:
            return 1
        return count_for_size(results.available, wish.size, lambda n: known(some, n))

    def encode(part: Splats) -> int:
        return files.sample_bytes(part, packing.options(len(part)))

    return guess_count(some, results.available, wish.size, encode)


def _smallest(
    results: Results[T], wish: Wish, sample: Splats, files: Files[T], progress: Tracker
) -> Packing:
    """The packing of the smallest files, of which the smallest of all is made if it may matter.

    So the same size is the least that can be had, whatever is asked for.

    Raises:
        TooSmallError: That is too large.
    """
    packing, fewest = wish.smallest(sample.sh_degree), results.fewest
    if (known := wish.known.file_bytes) is not None:
        needed = known(sample.with_sh_degree(packing.sh_degree), fewest)
    else:
        progress.begin("guess")
        if _guess(results, wish, sample, files, packing) > FEW * fewest:
            return packing
        chosen = results.packed(packing.sh_degree, wish.share(packing, fewest))
        within = progress.within(0, 1, chosen.stages(fewest))
        options = packing.options(fewest)
        _, needed = chosen.marked(fewest, partial(files.bytes_of, options=options), within)
    if needed > wish.size:
        raise too_small(wish.size, fewest, needed)
    return packing


def _filled(
    results: Results[T],
    wish: Wish,
    sample: Splats,
    files: Files[T],
    packed: Packed,
    progress: Tracker,
) -> tuple[T, Filled]:
    """The result that fills a size as it is packed.

    Raises:
        TooSmallError: Not even the fewest splats fit, so packed.
    """
    packing, count = packed.packing, packed.count

    def bytes_of(result: T) -> int:
        return files.bytes_of(result, packing.options(files.count(result)))

    chosen = results.packed(packing.sh_degree, wish.share(packing, count))
    if (known := wish.known.file_bytes) is not None:
        like = sample.with_sh_degree(packing.sh_degree)
        count = count_for_size(results.available, wish.size, lambda n: known(like, n))
        count = max(count, results.fewest)
        fitted = Fitted(count, known(like, count), ())
        if fitted.bytes > wish.size:
            raise too_small(wish.size, count, fitted.bytes)
        progress.begin("deliver")
        result = chosen.make(count, progress.within(0, 1, chosen.stages(count)))
    else:
        near = packed.tight or bool(packed.packings)
        result, fitted = fit_size(chosen, wish.size, count, bytes_of, progress, near=near)
    return result, Filled(fitted, packed)


def _attempts(results: Results[T], wish: Wish, files: Files[T], progress: Tracker) -> Try:
    """Makes results one after the other, and looks at their files."""
    tried = 0

    def attempt(packing: Packing, count: int, look: Look) -> list[PackingReport]:
        nonlocal tried
        count = min(max(count, results.fewest), results.available)
        some = results.brief().packed(packing.sh_degree, wish.share(packing, count))
        probe = progress.within(tried, PACKINGS, [*some.stages(count), Stage("encode", 1.0)])
        tried += 1

        def mark(result: T) -> list[dict[str, Any]]:
            probe.begin("encode")
            return [asdict(each) for each in look(partial(_seen, files, result))]

        _, found = some.marked(count, mark, probe)
        return [PackingReport(**each) for each in found]

    return attempt


def _seen(files: Files[T], result: T, packing: Packing) -> PackingReport:
    count = files.count(result)
    options = packing.options(count)
    return PackingReport(
        packing.sh_degree, options, count, *files.seen(result, packing.sh_degree, options)
    )
