"""Choice of SH degree, palette size and bits for a file of a given size.

A megabyte holds many splats of one colour each, or fewer whose colour depends on the view; only
renders show which looks better. Each packing is tried at a count that about fills the size: a
result is made for it, packed, unpacked and compared with the original on views. The bits are chosen
among files of the first result, since they hardly depend on the other choices. Lower degrees are
measured on the first result as well; only one that is not far behind gets a result of its own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from nanogs.io.format import PALETTE
from nanogs.pipeline.search.file_size import AIM
from nanogs.pipeline.search.packing import LARGER, OWN_HARMONICS, SMALLER, Choices, Packing
from nanogs.report import PackingReport

# Limits of a measured slope, dB of quality for e times the bytes.
SLOPES = 2.0, 40.0
SAVED = 1.2  # first count over the guess: there is room, because coarser bits are mostly the best
# |log(bytes / size)| up to which a result is not made again with another count: for a packing, and
# for the bits that are best with it; files that near the size are compared directly.
NEAR, NEAR_BITS = 0.12, 0.03
# dB by which a degree or palette may be behind, unfitted, and still be tried.
BEHIND = 1.5
STEEPER = 1.5  # times the slope that bits were compared with, from which they are compared again
FINE = 0.25  # dB by which a packing may be behind the best and still be tried with other bits

MeasureFile = Callable[[Packing], PackingReport]
"""Packs the current result, whose SH degree may be higher than the packing's, and measures it."""
MeasureFiles = Callable[[MeasureFile], list[PackingReport]]
"""Measures some packings of a result with the given function, and returns their reports."""
MakeAndMeasure = Callable[[Packing, int, MeasureFiles], list[PackingReport]]
"""Makes the result with the packing's SH degree and a count, and measures packings of it."""


def choose_packing(
    choices: Choices,
    size: int,
    slope: float,
    guess: Callable[[Packing], int],
    attempt: MakeAndMeasure,
    available: int,
) -> tuple[Packing, int, tuple[PackingReport, ...]]:
    """Search for the packing whose file of a given size looks best.

    Args:
        choices: What may be chosen.
        size: Bytes that the file may have.
        slope: Quality gained by more splats, dB for e times the bytes.
        guess: Estimates how many of the model's own splats fill the size with a packing.
        attempt: Makes a result and measures files of it.
        available: Splats of the whole model.

    Returns:
        The packing, a count that about fills the size with it, and what was tried in order.
    """
    search = _Search(choices, size, slope, guess, attempt, available)
    best = search.begin()
    first = best
    if search.own_fit >= OWN_HARMONICS:
        finest = (choices.own_per_entry, *LARGER[::-1])
        best = search.climb(first, [replace(first, per_entry=per_entry) for per_entry in finest])
    elif search.smaller:
        best = search.climb(first, [replace(first, per_entry=per_entry) for per_entry in SMALLER])
    if best is first and first.per_entry is not None:
        best = search.climb(first, [replace(first, per_entry=per_entry) for per_entry in LARGER])
    lower = [replace(best, sh_degree=degree) for degree in search.promising]
    best = search.climb(best, lower)
    if first.per_entry is not None:  # without palettes, `begin` has compared the bits
        best = search.compare_bits(best)
    return search.again(best), search.filling(best), tuple(search.probes)


def slope_of(choices: Choices, less: PackingReport, more: PackingReport) -> float:
    """Compute the quality gained by more splats, dB for e times the bytes.

    It is measured from two files that are packed alike.
    """
    wider = math.log(more.bytes / less.bytes)
    rise = choices.quality(more) - choices.quality(less)
    if wider <= 0 or not math.isfinite(rise):
        return SLOPES[1]
    return min(max(rise / wider, SLOPES[0]), SLOPES[1])


_Values = tuple[tuple[str, int], ...]


def _plain(packing: Packing) -> Packing:
    return replace(packing, bits=(), derived_options=())


def _with_bits(packing: Packing, name: str, value: int) -> Packing:
    bits = tuple((dict(packing.bits) | {name: value}).items())
    return replace(packing, bits=bits, derived_options=())


@dataclass(slots=True)
class _Search:
    """A search for the best packing, with the files that it has measured.

    Attributes:
        found: Files by packing without bits (degree and splats per entry), then by their bits.
        promising: Lower degrees that are not far behind although no result was fitted for them.
        smaller: Whether a smaller palette is not far behind either, so that it is tried.
        compared_at: The slope that bits were last compared with.
    """

    choices: Choices
    size: int
    slope: float
    guess: Callable[[Packing], int]
    attempt: MakeAndMeasure
    available: int
    found: dict[Packing, dict[_Values, PackingReport]] = field(default_factory=dict)
    probes: list[PackingReport] = field(default_factory=list)
    promising: list[int] = field(default_factory=list)
    smaller: bool = False
    compared_at: float = math.inf

    def begin(self) -> Packing:
        """Make the first result, and find the best bits for it."""
        first = self.choices.first
        saved = SAVED if self.choices.bits else 1.0
        count = min(max(int(saved * self.guess(first)), 1), self.available)
        probes = self._tried(
            first, count, lambda measure: self._measure_files(first, measure, lower=True)
        )
        best = self._keep(first, [probe for probe in probes if self._is_packed(probe, first)])
        found = self._best_file(first)
        others = [probe for probe in probes if self._promises(probe, found)]
        self.promising = [each.sh_degree for each in others if each.sh_degree < first.sh_degree]
        if first.per_entry is None:
            return self.compare_bits(best)
        small = replace(first, per_entry=SMALLER[0])
        self.smaller = any(self._is_packed(each, small) for each in others)
        return self._make(self.again(best), self._filling(found)) if self._is_far(found) else best

    def compare_bits(self, best: Packing) -> Packing:
        """Find the best bits, making results that fill the size while they may change it.

        One result does not show how much splats gain with each choice of bits: they gain more if
        nearly all of them fit, and hardly anything if bits are coarse. So bits get a result of
        their own as long as the quality hoped for is above that measured for others. If only one
        choice was seen, it stays.
        """
        files = self.found[_plain(best)]
        if len(files) == 1:
            return best
        best = replace(best, bits=max(files, key=partial(self._hope, best, set())))
        # A result with a palette takes long: the first one is good enough if it leaves room.
        if best.per_entry is not None and files[best.bits].bytes < self.size:
            return best
        return self._fill(best, NEAR_BITS)

    def _fill(self, packing: Packing, near: float) -> Packing:
        """Make results that fill the size, each with the bits that promise most by then.

        Args:
            packing: A packing of which several bits were compared.
            near: |log(bytes / size)| up to which a result is not made again.
        """
        files, made = self.found[_plain(packing)], set[_Values]()
        while True:
            best = replace(packing, bits=max(files, key=partial(self._hope, packing, made)))
            before = files[best.bits]
            if best.bits in made or not self._is_far(before, near):
                return best
            probes = self._again(best, self._filling(before))
            new = {self._bits_of(probe): probe for probe in probes}
            files |= {bits: probe for bits, probe in new.items() if bits not in made}
            made.add(best.bits)
            less, more = sorted((before, probes[0]), key=lambda each: each.bytes)
            if more.bytes > (1 + NEAR_BITS) * less.bytes:
                self.slope = max(self.slope, slope_of(self.choices, less, more))

    def _hope(self, packing: Packing, made: set[_Values], bits: _Values) -> float:
        """Estimate the best quality, dB, of a result that fills the size with these bits."""
        file = self.found[_plain(packing)][bits]
        over, slope = self._over(file), self.slope
        if over > 0 and bits not in made and packing.per_entry is None:
            slope = SLOPES[0]  # the loss from fewer splats is not measured yet
        loss = missing = self.choices.loss(file)
        if self._is_steep:  # then what more splats diminish is at most the least loss measured
            counted = (probe for probe in self.probes if probe.count <= file.count)
            missing = min(map(self.choices.loss, counted))
        loss += missing * math.expm1(slope * over * math.log(10) / 10)
        return -10 * math.log10(loss) if loss > 0 else math.inf

    def climb(self, best: Packing, others: Sequence[Packing]) -> Packing:
        """Try packings in order while each is better than the last, and return the best."""
        for other in others:
            given = replace(other, bits=self._bits_for(other, best))
            if self._value(given) <= self._value(best):
                break
            best = self._best(given)
        return best

    def _bits_for(self, packing: Packing, best: Packing) -> _Values:
        """Return the bits to try a packing with: about those of the best.

        A smaller palette takes too few bytes for fewer bits of its harmonics to save much. A larger
        one leaves no room for as many as a small one could have.
        """
        if packing.per_entry == best.per_entry:
            return best.bits
        names = self.choices.bits
        limited = max if (packing.per_entry or 0) > (best.per_entry or 0) else min
        return tuple(
            (name, limited(value, names[name].begin) if names[name].of_harmonics else value)
            for name, value in best.bits
        )

    def again(self, packing: Packing) -> Packing:
        """Return a tried packing for another result of about the same count.

        The options that were derived from its result are fixed in it.
        """
        file, chosen = self._file(packing), {PALETTE, *self.choices.bits}
        derived = [item for item in file.options.items() if item[0] not in chosen]
        return replace(packing, derived_options=tuple(derived))

    @property
    def own_fit(self) -> float:
        """Share of all splats that fit with harmonics of their own; 0 if there is no choice."""
        first = self.choices.first
        if first.per_entry is None:
            return 0.0
        return self.guess(replace(first, per_entry=self.choices.own_per_entry)) / self.available

    def filling(self, packing: Packing) -> int:
        """Return a count that about fills the size with a packing that was tried."""
        return self._filling(self._file(packing))

    def _file(self, packing: Packing) -> PackingReport:
        return self.found[_plain(packing)][packing.bits]

    def _value(self, packing: Packing) -> float:
        """Return the worth of a degree and palette; results are made if it was not tried yet."""
        if _plain(packing) not in self.found:
            best = self._make(packing, self._expected(packing), near=True)
            if self._is_far(found := self._best_file(packing)):
                if len(self.found[_plain(packing)]) > 1:  # bits were compared
                    self._fill(best, NEAR)
                else:
                    self._make(self.again(best), self._filling(found))
        return self._worth(self._best_file(packing))

    def _make(self, packing: Packing, count: int, *, near: bool = False) -> Packing:
        measure_files = partial(self._measure_files, packing, near=near)
        return self._keep(packing, self._tried(packing, count, measure_files))

    def _is_far(self, found: PackingReport, near: float = NEAR) -> bool:
        """Whether a file's size is too far off to show how good one of the right size is."""
        far = abs(math.log(found.bytes / self.size)) > near
        return far and self._filling(found) != found.count

    def _keep(self, packing: Packing, probes: Sequence[PackingReport]) -> Packing:
        self.found[_plain(packing)] = {self._bits_of(probe): probe for probe in probes}
        if len(probes) > 1:
            self.compared_at = self.slope
        return self._best(packing)

    def _best(self, packing: Packing) -> Packing:
        """Return a packing that was tried, with its best bits."""
        return replace(packing, bits=self._bits_of(self._best_file(packing)), derived_options=())

    def _best_file(self, packing: Packing) -> PackingReport:
        return max(self.found[_plain(packing)].values(), key=self._worth)

    def _is_packed(self, probe: PackingReport, packing: Packing) -> bool:
        """Whether a file has the degree and palette size of a packing, with any bits."""
        palette = packing.options(probe.count).get(PALETTE)
        return probe.sh_degree == packing.sh_degree and probe.options.get(PALETTE) == palette

    def _bits_of(self, probe: PackingReport) -> _Values:
        names = self.choices.bits
        return tuple((name, probe.options[name]) for name in names)

    def _measure_files(
        self, packing: Packing, measure: MeasureFile, *, lower: bool = False, near: bool = False
    ) -> list[PackingReport]:
        """Measure files of a result; of the first one also with other bits, palette and degrees.

        A small palette loses so much that it hides the effect of bits, so other bits are tried
        again with a larger one.

        Args:
            packing: How the result is packed.
            measure: Packs the result and measures the file.
            lower: Whether it is the first result.
            near: Whether other bits are tried only if the file is near the size, since otherwise
                another result is made, and not far behind the best.
        """
        usual = self.choices.first.per_entry
        larger = usual is not None and (packing.per_entry is None or packing.per_entry < usual)
        best = measure(packing)
        probes = [best]
        if near and (self._is_far(best) or self._worth(best) < self._most - FINE):
            return probes
        for name, each in self.choices.bits.items():
            began = dict(packing.bits)[name]
            for way in each.ways(began, finer=larger) if lower or larger else ():
                for value in way:
                    changed = _with_bits(packing, name, value)
                    probes.append(measure(changed))
                    if self._worth(probes[-1]) <= self._worth(best):
                        break
                    best, packing = probes[-1], changed
                if dict(packing.bits)[name] != began:
                    break
        if lower and packing.sharing:
            probes.append(measure(replace(packing, per_entry=SMALLER[0])))
        for degree in reversed(self.choices.degrees[:-1]) if lower else ():
            probes.append(measure(replace(packing, sh_degree=degree)))
            if not self._promises(probes[-1], best):
                break
        return probes

    def _promises(self, lower: PackingReport, best: PackingReport) -> bool:
        return self._worth(lower) > self._worth(best) - BEHIND

    @property
    def _most(self) -> float:
        """Worth of the best file so far."""
        return max(self._worth(found) for files in self.found.values() for found in files.values())

    def _worth(self, found: PackingReport) -> float:
        return self.choices.quality(found) - self.slope * self._over(found)

    def _over(self, found: PackingReport) -> float:
        """Return log(bytes / size) of a file, as far below 0 as more splats can fill the room."""
        return max(math.log(found.bytes / self.size), math.log(found.count / self.available))

    def _tried(
        self, packing: Packing, count: int, measure_files: MeasureFiles
    ) -> list[PackingReport]:
        probes = self.attempt(packing, count, measure_files)
        self.probes += probes
        return probes

    @property
    def _is_steep(self) -> bool:
        """Whether splats gain much more than was believed when bits were compared."""
        return self.slope > STEEPER * self.compared_at

    def _again(self, packing: Packing, count: int) -> list[PackingReport]:
        """Make a result of another count for a packing that was tried, and measure its file.

        If splats gain much more than was believed, files with one bit more or fewer follow.
        """
        packing = self.again(packing)
        tried = [packing]
        for name, value in packing.bits if self._is_steep else ():
            for way in self.choices.bits[name].ways(value):
                tried += [_with_bits(packing, name, other) for other in way[:1]]
        return self._tried(packing, count, lambda measure: [*map(measure, tried)])

    def _expected(self, packing: Packing) -> int:
        """Estimate the count that fills the size, from those for the model's own splats."""
        before = self._best([*self.found][-1])
        share = self.guess(packing) / max(self.guess(before), 1)
        return min(max(int(self.filling(before) * share), 1), self.available)

    def _filling(self, found: PackingReport) -> int:
        return min(max(int(found.count * AIM * self.size / found.bytes), 1), self.available)
