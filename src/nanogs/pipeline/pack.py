"""Choice of a packing for a size: each one tried is written, read back and measured on views."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Generic, TypeVar

from nanogs.pipeline.fit_size import guess_count
from nanogs.pipeline.packing import Choices, Look, Packing, choose_packing, slope_of, unseen_packing
from nanogs.pipeline.results import Results
from nanogs.pipeline.target import count_for_size
from nanogs.pipeline.weights import PACKINGS
from nanogs.pipeline.wish import Files, Wish
from nanogs.progress import Stage, Tracker
from nanogs.report import PackingReport
from nanogs.splats import Splats

T = TypeVar("T")
BLIND = "Nothing of the model is visible, so how the file is packed was not chosen by looking."
CUTS = 0.5, 0.8  # of the count that fills a size: two plain cuts, from which the slope is measured


@dataclass(frozen=True, slots=True)
class Packed:
    """How results are packed, chosen by looking.

    Attributes:
        packing: The best.
        count: Splats that about fill the size with it.
        packings: What was tried.
        highest: The highest degree of harmonics that could be written.
        tight: Whether nothing but the smallest packing fits.
        blind: Whether views were to tell which is best, but show nothing of the model.
    """

    packing: Packing
    count: int
    packings: tuple[PackingReport, ...]
    highest: int
    tight: bool = False
    blind: bool = False

    def entries(self, count: int) -> dict[str, Any]:
        """Fields of the report that say how a result of so many splats is packed."""
        return {"packings": self.packings, "format_options": self.packing.options(count)}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on what a user might not expect, a sentence each."""
        if self.blind:
            return (BLIND,)
        kept = self.packing.sh_degree
        why = "nothing else fits" if self.tight else "so the file shows more"
        left = f"Spherical harmonics above degree {kept} are left out: {why}."
        return (left,) if kept < self.highest else ()


@dataclass(eq=False)
class Packer(Generic[T]):
    """Chooses how results of a model are packed, by making some and measuring their files.

    Attributes:
        results: Of the model.
        wish: What is asked of the file.
        sample: Some usable splats of the model.
        files: Writes results.
        progress: Told of each stage.
        tried: Results that were made to choose by.
    """

    results: Results[T]
    wish: Wish
    sample: Splats
    files: Files[T]
    progress: Tracker
    tried: int = field(default=0, init=False)
    _guesses: dict[Packing, int] = field(default_factory=dict, init=False)

    def pack(self) -> Packed:
        """Choose how results are packed."""
        choices = self.wish.choices(self.sample.sh_degree)
        self.progress.begin("guess")
        looks = self.results.looks and choices.any
        if not looks or not self.files.shows():
            packing = self._unseen(choices)
            return Packed(packing, self.guess(packing), (), packing.sh_degree, blind=looks)
        self.progress.begin("pack")
        slope = self._slope(choices)
        given = self.guess, self._attempt, self.results.available
        return Packed(*choose_packing(choices, self.wish.size, slope, *given), choices.degrees[-1])

    def _unseen(self, choices: Choices) -> Packing:
        """The packing where nothing is rendered; without choices where a PSNR is to be reached."""
        if choices.by_psnr:
            return Packing(choices.degrees[-1])
        return unseen_packing(choices, self.guess, self.results.available)

    def guess(self, packing: Packing) -> int:
        """About how many of the model's own splats fill the size with a packing."""
        if packing not in self._guesses:
            self._guesses[packing] = self._guess(packing)
        return self._guesses[packing]

    def _guess(self, packing: Packing) -> int:
        some, available = self.sample.with_sh_degree(packing.sh_degree), self.results.available
        if (known := self.wish.known.file_bytes) is not None:
            if known(some, 1) > self.wish.size:
                return 1
            return count_for_size(available, self.wish.size, lambda count: known(some, count))

        def encode(part: Splats) -> int:
            return self.files.sample_bytes(part, packing.options(len(part)))

        return guess_count(some, available, self.wish.size, encode, self.wish.known.around())

    def made(self, packing: Packing) -> Results[T]:
        """Results that are made for a packing."""
        return self.results.packed(packing.sh_degree, self.wish.sharing(packing))

    def within(self, count: int) -> int:
        """The nearest count that can be delivered."""
        return min(max(count, self.results.fewest), self.results.available)

    def _slope(self, choices: Choices) -> float:
        """Quality that more splats bring, from two plain cuts that no palette blurs."""
        packing, plain = replace(choices.first, share=None), self.results.plain(rounds=0)
        count = self.guess(choices.first)

        def shown(share: float) -> PackingReport:
            some = self.within(round(share * count))
            part = self.progress.within(0, PACKINGS, plain.stages(some))
            _, found = plain.marked(some, lambda one: asdict(self._seen(one, packing)), part)
            return PackingReport(**found)

        return slope_of(choices, *map(shown, CUTS))

    def _attempt(self, packing: Packing, count: int, look: Look) -> list[PackingReport]:
        """Make a result and look at files of it; see `packing.Try`."""
        count = self.within(count)
        some = self.made(packing)
        brief = some.brief()
        stages = [*brief.stages(count), Stage("encode", 1.0)]
        part = self.progress.within(self.tried, PACKINGS, stages)
        self.tried += 1

        def mark(result: T) -> list[dict[str, Any]]:
            part.begin("encode")
            return [asdict(each) for each in look(partial(self._seen, result))]

        _, found = brief.marked(count, mark, part)
        return [PackingReport(**each) for each in found]

    def _seen(self, result: T, packing: Packing) -> PackingReport:
        options = packing.options(self.files.count(result))
        return self.files.seen(result, packing.sh_degree, options)


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
        if self.wish.known.file_bytes is not None:  # only the count decides it: nothing to choose
            return self.results, count
        self.progress.begin("guess")
        plain = self.results.plain(rounds=0)
        within = self.progress.within(0, 1, plain.stages(count))
        _, size = plain.marked(count, partial(self.files.bytes_of, options={}), within)
        wish = self.wish._replace(size=size, by_psnr=True)
        packer = Packer(self.results, wish, self.sample(), self.files, self.progress)
        packed = packer.pack()
        self.packed = packed if packed.packings else None
        return packer.made(packed.packing), packed.count

    def options(self, result: T) -> dict[str, Any]:
        """Options of the format that a result is packed with."""
        return self.packed.packing.options(self.files.count(result)) if self.packed else {}

    def entries(self, result: T) -> dict[str, Any]:
        """Fields of the report that say how a result is packed; none where it was not."""
        return self.packed.entries(self.files.count(result)) if self.packed else {}

    @property
    def notes(self) -> tuple[str, ...]:
        """As `Packed` has them."""
        return self.packed.notes if self.packed else ()
