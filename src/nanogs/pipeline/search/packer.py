"""Choice of a packing for a file size: each candidate is written, read back and rendered."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from typing import Any, Generic

from nanogs.io.format import PALETTE
from nanogs.io.limits import degree_left_out
from nanogs.pipeline.estimates.stage_weights import PACKINGS
from nanogs.pipeline.options.target import count_for_size
from nanogs.pipeline.search.choose_packing import MeasureFiles, choose_packing
from nanogs.pipeline.search.file_size import guess_count
from nanogs.pipeline.search.files import Files
from nanogs.pipeline.search.measured_files import MeasuredFiles
from nanogs.pipeline.search.packing import Choices, Packing, unseen_packing
from nanogs.pipeline.search.plain_cuts import look_at_cuts
from nanogs.pipeline.search.results import Results, T
from nanogs.pipeline.search.size_request import SizeRequest
from nanogs.progress import Stage, Tracker
from nanogs.report import PackingReport
from nanogs.splats import Splats

BLIND = "No view shows the model, so the packing of the file was not chosen by how it looks."
# Values of a delivered result are rounded so that they pack well, those of results that are only
# compared to the nearest. The ratio of the bytes of both files, without and with harmonics, which
# are not rounded so and are most of a file: assumed here, in trained scenes 0.84 to 0.97 and 0.92
# to 0.995. It is measured for each result that is compared, to correct the count.
ROUNDED, ROUNDED_HARMONICS = 0.92, 0.98
# The ratio after a whole fit over the measured one. With harmonics it is a little more than in
# trained scenes, because rounding could not make a file that is too large fit.
WHOLE, WHOLE_HARMONICS = 0.99, 1.005
MOST_SAVED = 2.0  # -log of the share of a plain cut's bytes with which a fit may reach its PSNR


_ResultKey = tuple[int, int, int | None]
"""What a result was made with: its count, SH degree and palette size."""


@dataclass(frozen=True, slots=True)
class ChosenPacking:
    """The packing of results that was chosen, by rendering where possible.

    Attributes:
        packing: The best packing.
        count: Number of splats that about fills the size with it.
        packings: Reports of the packings that were tried.
        highest: The highest degree of harmonics that could be written.
        wanted: The degree that would be written if the format had room for it.
        suffix: Name of the format.
        tight: Whether only the smallest packing fits.
        blind: Whether views were to decide which packing is best, but show nothing of the model.
    """

    packing: Packing
    count: int
    packings: tuple[PackingReport, ...]
    highest: int
    wanted: int
    suffix: str
    tight: bool = False
    blind: bool = False

    def report_fields(self, count: int) -> dict[str, Any]:
        """Return the report fields on how a result of `count` splats is packed."""
        return {"packings": self.packings, "format_options": self.packing.options(count)}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on a choice that the user might not expect, a sentence each."""
        return (*[BLIND] * self.blind, *self._left_out())

    def _left_out(self) -> tuple[str, ...]:
        """Return the sentence on harmonics that are left out, by choice or for want of room."""
        kept, beyond = self.packing.sh_degree, self.wanted > self.highest
        if kept == self.highest:
            return (degree_left_out(self.suffix, kept),) if beyond else ()
        why = "nothing else fits" if self.tight else "the file looks better without them"
        limit = f", and {self.suffix} holds none above degree {self.highest}" if beyond else ""
        return (f"Spherical harmonics above degree {kept} are left out, because {why}{limit}.",)


@dataclass(eq=False)
class Packer(Generic[T]):
    """Chooses the packing of a model's results, by making some and measuring their files.

    Attributes:
        results: Makes results of the model.
        request: What is asked of the file.
        sample: Some usable splats of the model.
        files: Writes and measures results.
        progress: Notified of each stage.
        tried: Number of results that were made to choose by.
    """

    results: Results[T]
    request: SizeRequest
    sample: Splats
    files: Files[T]
    progress: Tracker
    tried: int = field(default=0, init=False)
    _guesses: dict[Packing, int] = field(default_factory=dict, init=False)
    # By result: the bytes of a file whose values are rounded so that they pack well, over those of
    # one with the nearest values.
    _rounding_ratios: dict[_ResultKey, float] = field(default_factory=dict, init=False)

    def pack(self) -> ChosenPacking:
        """Choose the packing."""
        choices = self.choices
        packed = partial(
            ChosenPacking,
            highest=choices.degrees[-1],
            wanted=self.request.wanted(self.sample.sh_degree),
            suffix=self.request.known.suffix,
        )
        self.progress.begin("guess")
        looks = self.results.looks and choices.any
        if not looks or not self.files.shows():
            packing = self._unseen()
            return packed(packing, self.guess(packing), (), blind=looks)
        self.progress.begin("pack")
        measured = look_at_cuts(choices, self._size, self.results.available, self._measure_cut)
        make_and_measure = partial(self._make_and_measure, measured)
        packing, count = choose_packing(measured, self.guess, make_and_measure)
        if self.rounds:
            count = self._rounded_count(measured, packing, count)
        return packed(packing, count, tuple(measured.reports))

    @cached_property
    def choices(self) -> Choices:
        """The degrees, palettes and bits that may be chosen for the model."""
        return self.request.choices(self.sample.sh_degree)

    @property
    def rounds(self) -> bool:
        """Whether values of delivered results are rounded so that they pack well."""
        return self.results.fits and self.request.known.quantisation is not None

    @property
    def _usual_ratio(self) -> float:
        """The usual ratio of the bytes by rounding; 1 if delivered values are the nearest, too."""
        if not self.rounds:
            return 1.0
        return ROUNDED_HARMONICS if self.sample.sh_degree else ROUNDED

    @property
    def _size(self) -> int:
        """Bytes that files which are compared may have: their values are the nearest."""
        return int(self.request.size / self._usual_ratio)

    def _unseen(self) -> Packing:
        """Return the packing if nothing is rendered.

        If a PSNR is to be reached, that is all harmonics and the format's own defaults.
        """
        if self.choices.by_psnr:
            return Packing(self.choices.degrees[-1])
        return unseen_packing(self.choices, self.guess, self.results.available)

    def guess(self, packing: Packing) -> int:
        """Estimate how many of the model's own splats fill the size with a packing."""
        if packing not in self._guesses:
            self._guesses[packing] = self._guess(packing)
        return self._guesses[packing]

    def _guess(self, packing: Packing) -> int:
        some, available = self.sample.with_sh_degree(packing.sh_degree), self.results.available
        if (known := self.request.known.file_bytes) is not None:
            if known(some, 1) > self.request.size:
                return 1
            return count_for_size(available, self.request.size, lambda count: known(some, count))

        def encode(part: Splats) -> int:
            return self.files.sample_bytes(part, packing.options(len(part)))

        return guess_count(some, available, self._size, encode, self.request.known.overhead_bytes())

    def results_for(self, packing: Packing) -> Results[T]:
        """Return a maker of results that suit a packing."""
        return self.results.packed(packing.sh_degree, self.request.sharing(packing))

    def deliverable(self, count: int) -> int:
        """Return the deliverable count nearest to a count."""
        return min(max(count, self.results.fewest), self.results.available)

    def _measure_cut(self, share: float, measure_files: MeasureFiles) -> list[PackingReport]:
        """Make a plain cut and measure its files; see `plain_cuts.MeasureCut`."""
        plain, count = self.results.plain(rounds=0), self.guess(self.choices.first)
        some = self.deliverable(round(share * count))

        part = self.progress.within(0, PACKINGS, plain.stages(some))
        return _make_and_measure_files(plain, self.files, some, measure_files, part)

    def _make_and_measure(
        self, measured: MeasuredFiles, packing: Packing, count: int, measure_files: MeasureFiles
    ) -> list[PackingReport]:
        """Make a result of a count and measure its files; see `choose_packing.MakeAndMeasure`."""
        count = self.deliverable(count)
        some = self.results_for(packing)
        brief = some.brief()
        stages = [*brief.stages(count), Stage("encode", 1.0)]
        part = self.progress.within(self.tried, PACKINGS, stages)
        self.tried += 1

        def measure(result: T) -> dict[str, Any]:
            part.begin("encode")
            found = measure_files(partial(_measure_file, self.files, result))
            file = found[0]
            if not measured.reports:  # results after the first are made for their bits
                alike = [each for each in found if measured.is_packed_as(each, packing)]
                file = max(alike, key=measured.value)
            ratio = self._rounding_ratio(result, file)
            return {"files": [asdict(each) for each in found], "rounded": ratio}

        _, made = brief.make_and_measure(count, measure, part)
        reports = [PackingReport(**each) for each in made["files"]]
        self._rounding_ratios[_result_of(reports[0])] = made["rounded"]
        return reports

    def _rounded_count(self, measured: MeasuredFiles, packing: Packing, count: int) -> int:
        """Return the count that fills the size once its values are rounded to pack well.

        Args:
            measured: The files that were compared; their values are the nearest.
            packing: The best packing.
            count: The count that fills the size if the usual ratio by rounding is right.
        """
        whole = WHOLE_HARMONICS if self.sample.sh_degree else WHOLE
        ratio = whole * self._rounding_ratios[_result_of(measured.file(packing))]
        count = self.deliverable(round(count * self._usual_ratio / ratio))
        # Of the whole model nothing is fitted, so its values are not rounded either.
        if measured.is_whole_larger(packing, self.request.size):
            return self.deliverable(min(count, self.results.available - 1))
        return count

    def _rounding_ratio(self, result: T, file: PackingReport) -> float:
        """Return the bytes of a file if values are rounded so that it packs well, over its own."""
        if not self.rounds:
            return 1.0
        if file.count == self.results.available:  # the model itself, of which nothing was fitted
            return self._usual_ratio
        coarseness = self.choices.coarseness(file)
        return self.files.packed(result, file.options, coarseness)[1] / file.bytes


def _measure_file(files: Files[T], result: T, packing: Packing) -> PackingReport:
    """Measure the file of a result in a packing."""
    return files.measure(result, packing.sh_degree, packing.options(files.count(result)))


def _make_and_measure_files(
    results: Results[T],
    files: Files[T],
    count: int,
    measure_files: MeasureFiles,
    progress: Tracker,
) -> list[PackingReport]:
    """Make the result of a count, and measure its files in some packings."""

    def measure(result: T) -> list[dict[str, Any]]:
        return [asdict(each) for each in measure_files(partial(_measure_file, files, result))]

    _, found = results.make_and_measure(count, measure, progress)
    return [PackingReport(**each) for each in found]


def _result_of(file: PackingReport) -> _ResultKey:
    return file.count, file.sh_degree, file.options.get(PALETTE)


@dataclass(eq=False)
class PackingForPsnr(Generic[T]):
    """Chooses the packing of results that must reach a PSNR, once their size is about known.

    Attributes:
        results: Makes results of the model.
        request: What is asked of the file; its `size` is ignored.
        sample: Returns some usable splats of the model.
        files: Writes and measures results.
        progress: Notified of each stage.
        packed: The choice; None before it is made, and if no packing was tried.
    """

    results: Results[T]
    request: SizeRequest
    sample: Callable[[], Splats]
    files: Files[T]
    progress: Tracker
    packed: ChosenPacking | None = None

    def __call__(self, count: int, slope: float) -> tuple[Results[T], int]:
        """Choose the packing for files about as large as the one that reaches the PSNR.

        Args:
            count: Splats of a plain cut that about reaches it.
            slope: PSNR gained by more splats, dB for e times as many.

        Returns:
            A maker of results that suit the packing, and a count whose file has about that size.
        """
        if self.request.known.file_bytes is not None:
            return self.results, count  # the count alone decides the size: nothing to choose
        self.progress.begin("guess")
        sample, request = self.sample(), self.request._replace(by_psnr=True)
        request = request._replace(size=self._size(request.choices(sample.sh_degree), count, slope))
        packer = Packer(self.results, request, sample, self.files, self.progress)
        packed = packer.pack()
        self.packed = packed if packed.packings else None
        return packer.results_for(packed.packing), packed.count

    def _size(self, choices: Choices, count: int, slope: float) -> int:
        """Estimate the bytes of the file that reaches the PSNR, as a plain cut about does.

        A fitted result of the count is better than the cut, so that fewer splats reach the PSNR.
        """
        packing = Packing(choices.degrees[-1])

        def measured(number: int, some: Results[T]) -> PackingReport:
            part = self.progress.within(number, 2, some.stages(count))
            (file,) = _make_and_measure_files(
                some, self.files, count, lambda measure: [measure(packing)], part
            )
            return file

        cut, brief = map(measured, (0, 1), (self.results.plain(rounds=0), self.results.brief()))
        gained = max(choices.quality(brief) - cut.psnr, 0.0)
        return round(cut.bytes * math.exp(-min(gained / slope, MOST_SAVED)))

    def smaller(self, whole: T, result: T, reaches: Callable[[], bool]) -> bool:
        """Whether the whole model, plainly packed, is better than a result; then nothing is chosen.

        A chosen packing may be finer than the defaults of the format, so that fewer splats can take
        more bytes.

        Args:
            whole: The whole model.
            result: A result that reaches the PSNR.
            reaches: Whether the whole model reaches the PSNR as it would be packed now.
        """
        before, bytes_of = self.packed, self.files.bytes_of
        if before is None or bytes_of(whole, {}) >= bytes_of(result, self.options(result)):
            return False
        self.packed = None
        if not reaches():
            self.packed = before
        return self.packed is None

    def options(self, result: T) -> dict[str, Any]:
        """Return the format options that a result is packed with."""
        return self.packed.packing.options(self.files.count(result)) if self.packed else {}

    def report_fields(self, result: T) -> dict[str, Any]:
        """Return the report fields on how a result is packed; empty if nothing was chosen."""
        return self.packed.report_fields(self.files.count(result)) if self.packed else {}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the choice; see `ChosenPacking.notes`."""
        return self.packed.notes if self.packed else ()
