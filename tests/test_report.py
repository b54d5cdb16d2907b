"""A report of a simplification in a line."""

import re

import nanogs
from builders import random_splats


def test_a_report_is_printed_in_a_line():
    report = nanogs.simplify(random_splats(300), ratio=0.1, preset="fast")[1]
    assert re.fullmatch(r"300 -> 30 splats, [\d.]+ s", str(report))


def test_what_was_measured_and_missed_is_in_it():
    report = nanogs.simplify(random_splats(300), psnr=99, preset="fast")[1]
    text = str(report)
    assert text.startswith(f"300 -> 300 splats, {report.judged.text}, ")
    assert text.endswith("so the whole model was written (stop: unreached).")
