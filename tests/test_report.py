"""The one-line texts of reports, which also stand for them in notebooks."""

import re

import pytest

import nanogs
from builders import random_splats
from nanogs.costs import DrawCost
from nanogs.protocol import Judged, PackingLoss
from nanogs.report import (
    DrawProbeReport,
    PassReport,
    ProbeReport,
    SimplifyReport,
    StopReason,
    measures,
    stop_text,
)


def made_up(stop, **values):
    """A report of 1,000 splats that became 100, with the given values."""
    return SimplifyReport(
        preset="fast", parameters={}, input_count=1000, asked_ratio=None, asked_count=100,
        dropped_nonfinite=0, pruned=0, prune_threshold=0.0, prune_limited=False, passes=(),
        achieved_count=100, stop=StopReason(stop), seconds={}, total_seconds=2.0, threads=1,
        **values,
    )  # fmt: skip


WHY = {
    ("no_progress", ()): "Stopped before the requested count was reached: no_progress.",
    ("unreached", ()): "No fewer splats than 1,000 can be tried, so the whole model was written"
    " (stop: unreached).",
    ("unreached", (ProbeReport(500, 30.0), ProbeReport(990, 39.756), ProbeReport(700, 35.0))):
    "39.76 dB with 990 of 1,000 splats is less than 40.5 dB, so the whole model was written"
    " (stop: unreached).",
    ("probes", (ProbeReport(500, 41.0), ProbeReport(490, 39.0))):
    "The search for the fewest splats ended after 2 counts; the result reaches 40.5 dB, but a"
    " smaller one might too (stop: probes).",
}  # fmt: skip


@pytest.mark.parametrize(("stop", "probes"), WHY)
def test_a_sentence_says_why_a_request_was_not_met(stop, probes):
    report, text = made_up(stop, asked_psnr=40.5, probes=probes), WHY[stop, probes]
    assert stop_text(report) == text
    assert str(report) == f"1,000 -> 100 splats, 2 s. {text}"


def test_a_sentence_says_that_the_search_for_a_draw_cost_ended_early():
    tried = (DrawProbeReport(500, 0.4),) * 3
    assert stop_text(made_up("probes", asked_draw_cost=0.5, draw_probes=tried)) == (
        "The search for the most splats ended after 3 counts; the result costs no more to draw than"
        " was asked, but a larger one might be possible (stop: probes)."
    )


def test_the_line_of_a_report_has_all_that_was_measured():
    half, whole = (DrawCost.usual(mean, 9, 1.0, 0.1, 5.0) for mean in (3.25, 6.5))
    report = made_up(
        "target", judged=Judged.usual(31.0, 0.9, 8), cost=half, original_cost=whole,
        packed=PackingLoss(".sog", 0.18, 0.0, 40.0, 0.99),
    )  # fmt: skip
    assert measures(report) == [
        report.judged.text, "packing alone costs 0.18 dB", "50.0% of the splats a pixel (3.2)",
    ]  # fmt: skip
    assert str(report) == f"1,000 -> 100 splats, {', '.join(measures(report))}, 2 s"
    for alone in ({"cost": half}, {"original_cost": whole}):  # no share can be told
        assert measures(made_up("target", **alone)) == []


def test_a_psnr_that_only_the_whole_model_reaches_is_met():
    for psnr, met in ((40.0, True), (39.9, False)):
        judged = Judged.usual(psnr, 0.9, 8)
        assert made_up("unreached", asked_psnr=40.0, judged=judged).met is met
        assert not made_up("probes", asked_psnr=40.0, judged=judged).met
    assert not made_up("unreached", asked_psnr=40.0).met
    assert [stop for stop in StopReason if made_up(stop).met] == ["target", "step", "settled"]


def test_a_pass_that_merged_nothing_says_whether_it_could_have():
    for without_cost, stop in ((4, "no_candidates"), (3, "no_progress")):
        assert PassReport(9, 4, without_cost, 0, 9, None, {}).stop == stop


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
