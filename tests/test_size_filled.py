"""Files that fill a size: their count, rounding, stop reason and notes, for synthetic files."""

from pathlib import Path

import numpy as np
import pytest

from builders import random_splats
from nanogs.io import registry
from nanogs.io.rate_distortion import Curvatures
from nanogs.pipeline.search.coarseness import COARSEST, FINER, FINEST
from nanogs.pipeline.search.file_size import AIM
from nanogs.pipeline.search.files import Files
from nanogs.pipeline.search.fill_size import fill_size
from nanogs.pipeline.search.latest import Latest
from nanogs.pipeline.search.packer import WHOLE, ChosenPacking, Packer
from nanogs.pipeline.search.packing import FINE, Packing
from nanogs.pipeline.search.size_request import SizeRequest
from nanogs.progress import Tracker
from nanogs.report import PackingReport, StopReason
from test_size_psnr import CountedResults

SPZ = registry.writable(Path("a.spz"))
PACKING = Packing(0, None, (("bits", 6),))


class RoundedFiles(Files[int]):
    """Files of `bytes_at` a count, times the coarseness to the power of -0.04."""

    def __init__(self, bytes_at):
        self.bytes_at, self.latest_filled, self.tried = bytes_at, Latest(), []

    def count(self, result):
        return result

    def curvatures(self, result):
        return Curvatures(*[np.ones(result, np.float32)] * 5)

    def packed(self, result, options, coarseness):
        self.tried.append(coarseness)
        return result, round(self.bytes_at(result) * coarseness**-0.04)


def test_values_are_finer_than_usual_only_in_a_file_that_holds_no_more_splats():
    files = RoundedFiles(lambda _: 1000)
    assert files.bytes_of(9, {}, 1060) == 1000
    assert min(files.tried) == pytest.approx(FINER)
    assert 0.98 * 1060 <= files.filled(9, {}, 1060)[1] <= 1060
    assert FINEST < files.tried[-1] < FINER
    assert files.filled(9, {}, 1300) == (9, 1000)  # out of reach: the usual values


def test_a_size_is_filled_around_the_coarseness_that_was_chosen():
    files = RoundedFiles(lambda _: 1000)
    assert 1000 <= files.bytes_of(9, {}, 1015, 0.5) <= 1015
    assert files.tried[0] == 0.5
    assert 0.5 < files.tried[-1] <= 0.5 * COARSEST
    assert files.filled(9, {}, 1015, 0.5)[1] == files.bytes_of(9, {}, 1015, 0.5)
    assert files.bytes_of(9, {}, coarseness=0.5) == round(1000 * 0.5**-0.04)


def test_one_result_is_rounded_to_a_size_once():
    files = RoundedFiles(lambda _: 1000)
    taken = files.bytes_of(9, {}, 1025)
    assert len(files.tried) > 1
    files.tried.clear()
    assert files.bytes_of(9, {}, 1025) == files.filled(9, {}, 1025)[1] == taken > 1000
    assert files.tried == []
    assert files.bytes_of(9, {}, 990) <= 990  # another size


class Results(CountedResults):
    """Results of a model of 1,000 splats, which are fitted."""

    fits = True

    def verify(self, result, progress):
        pass

    def brief(self):
        return self

    def packed(self, sh_degree, sharing):
        return self


class Packed(Results):
    """Results of a packing that was chosen by full results, which give the first count too."""

    def plain(self, rounds=None):
        raise AssertionError("no plain cuts improve that count")


class Filling:
    """In place of a `Packer`: one packing, at first with 400 splats, for a file of 1,000 B."""

    request, sample = SizeRequest(1000, SPZ, {}), random_splats(9, degree=0)
    results, progress = Packed(), Tracker(None, [])

    def __init__(self, bytes_at):
        self.files = RoundedFiles(bytes_at)

    def guess(self, packing):
        return 400

    def results_for(self, packing):
        return self.results

    def pack(self):
        tried = (PackingReport(0, {}, 400, 1, 30.0, 0.9, 31.0, 0.9),)
        return ChosenPacking(PACKING, 400, tried, 0, 0, ".spz")


@pytest.mark.parametrize(
    ("least", "stop", "taken", "notes"),
    [
        (900, StopReason.TARGET, (980, 1000), []),
        (500, StopReason.STEP, (500, 500), ["The file takes only 50% of the requested size"]),
    ],
)
def test_rounding_makes_up_for_a_count_that_leaves_some_room(least, stop, taken, notes):
    filling = Filling(lambda count: least if count <= 500 else 1200)
    result, fields, found = fill_size(filling)
    assert 495 <= result <= 500
    assert fields["stop"] is stop
    assert taken[0] <= fields["achieved_size"] <= taken[1]
    assert [note.partition(",")[0] for note in found] == notes


def test_a_model_that_fits_whole_is_not_rounded_more_finely():
    filling = Filling(lambda count: count // 4)
    result, fields, notes = fill_size(filling)
    assert (result, fields["achieved_size"], fields["stop"]) == (1000, 250, StopReason.TARGET)
    assert notes == ("The whole model fits into the requested size; nothing was merged.",)
    assert min(filling.files.tried) > 0.99 * FINER


def test_a_result_that_is_not_rounded_is_written_once():
    """It was not fitted, or is not held whole; then another coarseness changes nothing."""
    filling = Filling(lambda count: 500 if count <= 500 else 1200)
    filling.files.curvatures = lambda _: None
    _, fields, _ = fill_size(filling)
    assert filling.files.tried == [1.0] * len(fields["size_probes"])


@pytest.mark.parametrize("share", [0.95, 0.8])
@pytest.mark.parametrize(("unpacked", "coarseness"), [(60.0, FINE), (32.0, 1.0)])
def test_the_first_count_allows_for_what_rounding_saves(share, unpacked, coarseness):
    """As seen on a result that is only compared; after a whole fit it saves a little more.

    Where packing makes nearly all of the error, finer values are worth more than more splats.
    """

    class Compared(RoundedFiles):
        def shows(self):
            return True

        def sample_bytes(self, some, options):
            return 20 * len(some)

        def measure(self, result, sh_degree, options):
            psnr = 30 - abs(options["bits"] - 6)
            ssim = 0.9 if unpacked < 40 else 0.99
            scores = psnr, 0.9, unpacked, ssim
            return PackingReport(sh_degree, options, result, 20 * result, *scores)

    files = Compared(lambda count: share * 20 * count)
    sample, request = random_splats(50, degree=0), SizeRequest(10_000, SPZ, {"spare_bits": 2})
    packed = Packer(Results(), request, sample, files, Tracker(None, [])).pack()
    assert packed.packing.bits == PACKING.bits
    assert packed.packing.coarseness == coarseness
    _, taken = files.packed(packed.count, {}, coarseness)
    assert taken * WHOLE == pytest.approx(AIM * 10_000, rel=0.01)


@pytest.mark.parametrize(
    ("bit_bytes", "psnrs", "last", "chosen"),
    [
        (4, {5: -5.0, 7: 0.6}, 7, 6),  # 7 bits look better than they are with fewer splats
        (0.2, {4: -5.0}, 4, 5),  # one result is made, for 6 bits; nearly as many splats fit with 5
    ],
)
def test_what_rounding_saves_is_that_of_the_bits_that_were_chosen(bit_bytes, psnrs, last, chosen):
    class Compared(RoundedFiles):
        def shows(self):
            return True

        def sample_bytes(self, some, options):
            return 24 * len(some)  # so that the first result about fills the size with 6 bits

        def nearest(self, result, options):
            return round((20 + bit_bytes * (options["bits"] - 6)) * result)

        def packed(self, result, options, coarseness):
            share = 0.8 if options["bits"] == chosen else 0.5
            return result, round(share * self.nearest(result, options))

        def measure(self, result, sh_degree, options):
            psnr = 30 + 5 * np.log(result / 500) + psnrs.get(options["bits"], 0.0)
            size = self.nearest(result, options)
            return PackingReport(sh_degree, options, result, size, psnr, 0.9, 60.0, 0.9)

    files = Compared(lambda _: 0)
    sample, request = random_splats(50, degree=0), SizeRequest(10_000, SPZ, {"spare_bits": 2})
    packed = Packer(Results(), request, sample, files, Tracker(None, [])).pack()
    assert packed.packings[-1].options["bits"] == last
    assert packed.packing.bits == (("bits", chosen),)
    _, taken = files.packed(packed.count, {"bits": chosen}, 1.0)
    assert taken * WHOLE == pytest.approx(AIM * 10_000, rel=0.01)
