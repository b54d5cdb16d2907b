"""The result that fills a size: its packing is chosen first, then its count."""

from dataclasses import replace
from functools import partial

from nanogs.errors import TooSmallError
from nanogs.pipeline.options.target import count_for_size
from nanogs.pipeline.search.file_size import ENOUGH, FittedSize, fit_size, too_small, whole_fits
from nanogs.pipeline.search.packer import ChosenPacking, Packer
from nanogs.pipeline.search.packing import Packing
from nanogs.pipeline.search.results import Delivered, T
from nanogs.report import StopReason

# If this many times the fewest splats fit by the guess, the fewest certainly fit, and no file is
# made to check it.
FEW = 8


def fill_size(packer: Packer[T]) -> Delivered[T]:
    """Make the result of a model that is packed best and fills a size.

    Args:
        packer: Of the model's results, with what is asked.

    Raises:
        TooSmallError: Not even the fewest splats fit.
    """
    smallest = _smallest(packer)
    packed = packer.pack()
    try:
        result, fitted = _make_largest(packer, packed)
    except TooSmallError:
        fewest = packer.results.fewest
        packed = replace(packed, packing=smallest, count=fewest, tight=True)
        result, fitted = _make_largest(packer, packed)
    packer.results.verify(result, packer.progress)
    if fitted.count < packer.results.available and packer.files.curvatures(result) is not None:
        result, fitted = _fill_by_rounding(packer, packed, result, fitted)
    fields = {"achieved_size": fitted.bytes, "size_probes": fitted.probes, "stop": fitted.stop}
    fields |= packed.report_fields(packer.files.count(result))
    return Delivered(result, fields, _notes(packer, packed, fitted))


def _smallest(packer: Packer[T]) -> Packing:
    """Return the packing of the smallest files, after checking that the fewest splats fit.

    The size of their file is computed if the format allows it; if not, the file is made, unless the
    guess leaves ample room. So the least size that can be had is the same for every request.

    Raises:
        TooSmallError: Not even that file fits.
    """
    request, sample, fewest = packer.request, packer.sample, packer.results.fewest
    packing = request.smallest(sample.sh_degree)
    if (known := request.known.file_bytes) is not None:
        needed = known(sample.with_sh_degree(packing.sh_degree), fewest)
    else:
        packer.progress.begin("guess")
        if packer.guess(packing) > FEW * fewest:
            return packing
        chosen = packer.results_for(packing)
        part = packer.progress.within(0, 1, chosen.stages(fewest))
        size = partial(packer.files.bytes_of, options=packing.options(fewest))
        _, needed = chosen.make_and_measure(fewest, size, part)
    if needed > request.size:
        raise too_small(request.size, fewest, needed)
    return packing


def _fill_by_rounding(
    packer: Packer[T], packed: ChosenPacking, result: T, fitted: FittedSize
) -> tuple[T, FittedSize]:
    """Round the values of a result so that its file fills the size, as far as they can."""
    packing, size = packed.packing, packer.request.size
    options = packing.options(packer.files.count(result))
    result, taken = packer.files.filled(result, options, size, packing.coarseness)
    stop = StopReason.TARGET if taken >= ENOUGH * size else fitted.stop
    return result, replace(fitted, bytes=taken, stop=stop)


def _notes(packer: Packer[T], packed: ChosenPacking, fitted: FittedSize) -> tuple[str, ...]:
    """Return notes on room that is left, on the packing, and on a model that fits whole."""
    known, available = packer.request.known, packer.results.available
    notes = fitted.notes(packer.request.size, available, known.overhead_bytes()) + packed.notes
    if fitted.count == available and known.file_bytes is None:
        left_out = packed.packing.sh_degree < packer.sample.sh_degree
        notes += (whole_fits(left_out=left_out),)
    return notes


def _make_largest(packer: Packer[T], packed: ChosenPacking) -> tuple[T, FittedSize]:
    """Make the largest result that fits into the size in a packing; tell which counts were tried.

    Raises:
        TooSmallError: Not even the fewest splats fit in this packing.
    """
    request, files, progress = packer.request, packer.files, packer.progress
    packing = packed.packing
    chosen = packer.results_for(packing)
    if (known := request.known.file_bytes) is not None:
        like = packer.sample.with_sh_degree(packing.sh_degree)
        count = count_for_size(chosen.available, request.size, lambda n: known(like, n))
        count = max(count, chosen.fewest)
        fitted = FittedSize(count, known(like, count), ())
        if fitted.bytes > request.size:
            raise too_small(request.size, count, fitted.bytes)
        progress.begin("deliver")
        return chosen.make(count, progress.within(0, 1, chosen.stages(count))), fitted

    def bytes_of(result: T) -> int:
        options = packing.options(files.count(result))
        return files.bytes_of(result, options, request.size, packing.coarseness)

    near, overhead = packed.tight or bool(packed.packings), request.known.overhead_bytes()
    return fit_size(
        chosen, request.size, packed.count, bytes_of, progress, near=near, overhead=overhead
    )
