"""The one-line texts of reports, which also stand for them in notebooks."""

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


def test_reports_stand_in_a_notebook_as_one_line(tmp_path):
    model = random_splats(300)
    small, report = nanogs.simplify(model, ratio=0.1, preset="fast")
    assert repr(report) == f"SimplifyReport({report})"
    parameters = nanogs.RefitParameters(views=2, steps=2, size=32)
    _, refit = nanogs.refit(model, small, parameters=parameters)
    assert repr(refit) == f"RefitReport({refit})"
    assert re.fullmatch(r"30 splats fitted to 300, .* dB on .*: rounds, [\d.]+ m?s", str(refit))
    nanogs.save(small, tmp_path / "a.ply")
    line = repr(nanogs.info(tmp_path / "a.ply"))
    facts = r"ply, \S+ kB; 30 splats; SH degree 1; render mode default; bounds .*"
    assert re.fullmatch(rf"ModelInfo\(\S+a\.ply; {facts}\)", line)
