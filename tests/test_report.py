"""The one-line text of a simplification report."""

import re

import nanogs
from builders import random_splats


def test_a_report_is_printed_as_one_line():
    report = nanogs.simplify(random_splats(300), ratio=0.1, preset="fast")[1]
    assert re.fullmatch(r"300 -> 30 splats, [\d.]+ s", str(report))


def test_the_line_has_the_measured_psnr_and_says_if_it_was_missed():
    report = nanogs.simplify(random_splats(300), psnr=99, preset="fast")[1]
    text = str(report)
    assert text.startswith(f"300 -> 300 splats, {report.judged.text}, ")
    assert text.endswith("so the whole model was written (stop: unreached).")
