"""Tables, plots and means of `bench`, from made-up rows."""

import json
import math
from dataclasses import replace
from xml.etree import ElementTree as ET

import pytest

from nanogs.bench.digest import digest_of_sources
from nanogs.bench.means import mean_rows
from nanogs.bench.plot import curves, plot
from nanogs.bench.preamble import preamble
from nanogs.bench.published import DATASETS, Figures
from nanogs.bench.published_table import figures_cell, published_table
from nanogs.bench.rows import ORIGINAL, Against, BenchRow, SetScore, Status
from nanogs.bench.run import row_count, row_keys
from nanogs.bench.settings import BenchSettings
from nanogs.bench.tables import json_line, markdown, mean_table, scene_table
from nanogs.formatting import NONE, number_text


def row(scene="a", method="x", ratio=0.1, psnr=20.0, **values):
    return BenchRow(scene, method, ratio, psnr=psnr, **{"ssim": 0.9, "views": 2} | values)


def skipped(scene, method, ratio=0.1):
    return BenchRow(scene, method, ratio, Status.SKIPPED, "There is no file | here.")


# Rows


def test_only_a_row_with_a_score_that_has_not_failed_is_measured():
    for found, measured in (
        (row(psnr=0.0), True), (row(psnr=None), False), (skipped("a", "x"), False),
        (row(status=Status.FAILED), False),
    ):  # fmt: skip
        assert found.measured is measured


def test_the_sets_of_a_row_begin_with_its_own():
    far = SetScore("roam 512", 3, 25.0, 24.0, 0.8, {"flip": 0.2})
    found = row(label="auto 512", least_psnr=18.0, extras={"flip": 0.1}, further=(far,))
    assert found.sets == (SetScore("auto 512", 2, 20.0, 18.0, 0.9, {"flip": 0.1}), far)


def test_the_rows_of_a_scene_are_its_whole_models_then_all_methods_for_each_request():
    ratios = BenchSettings(ratios=(0.5, 0.1), methods=("fast", "random"), externals={"mine": "a"})
    names = ("fast", "random", "mine")
    assert row_keys(ratios) == [
        (ORIGINAL, (1.0, "", None)), *((name, (0.5, "", None)) for name in names),
        *((name, (0.1, "", None)) for name in names),
    ]  # fmt: skip
    sizes = BenchSettings(methods=("fast",), file_sizes=(2000, 1000), formats=(".sog", ".spz"))
    whole = [(ORIGINAL, (1.0, each, None)) for each in ("", ".sog", ".spz")]
    asked = [("fast", (None, each, size)) for each in (".sog", ".spz") for size in (1000, 2000)]
    assert row_keys(sizes) == [*whole, *asked]
    assert row_count([None] * 3, sizes) == 21


def test_the_text_above_the_tables_says_how_they_were_made(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 6)
    text = preamble(BenchSettings(sizes=(64, 512), kinds=("auto", "roam")))
    assert not text.startswith("```")
    assert "6 CPUs, all threads.\n" in text
    views = [f"8 auto of {size} x {size}" for size in (64, 512)]
    views += [f"24 roam of {size} x {size}" for size in (64, 512)]
    assert f"Views of scenes without photographs: {', '.join(views)}, which no method" in text
    assert "All models are drawn" not in text
    text = preamble(BenchSettings(views=3, threads=2, render_mode="mip"), "nanogs bench a.ply")
    assert text.startswith("```\nnanogs bench a.ply\n```\n\nnanogs ")
    assert "6 CPUs, 2 threads.\n" in text
    assert ": 3 auto of 512 x 512, which" in text
    assert "All models are drawn as mip, whatever their files say.\n\nEvery method" in text


def test_the_digest_of_sources_changes_with_each_file_that_counts(tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.bench.digest.PACKAGE", tmp_path)
    for name in ("a.py", "bench/b.py", "fit/c.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    found = [digest_of_sources(())]
    found += [digest_of_sources(apart) for apart in (["bench"], ["bench", "fit"])]
    assert [*map(len, found)] == [10, 10, 10]
    (tmp_path / "bench" / "b.py").write_text("other")
    (tmp_path / "fit" / "c.txt").write_text("no source")
    found += [digest_of_sources(apart) for apart in ((), ["bench"], ["bench", "fit"])]
    assert found[4:] == found[1:3]
    assert len({*found}) == 4


# Means


def test_a_mean_is_over_scenes_that_every_method_has():
    rows = [
        row("a", "x", psnr=10),
        row("a", "y", psnr=20),
        row("b", "x", psnr=30),
        skipped("b", "y"),
    ]
    (mean,) = mean_rows(rows)
    assert mean.scenes == ("a",)
    assert mean.methods["x"].psnr == 10
    assert mean.left_out == {"b": ("y",)}
    assert "left out: b, without a result of y" in mean_table([mean])


def test_a_method_without_any_result_is_named_and_does_not_empty_the_mean():
    (mean,) = mean_rows([row("a", "x", psnr=10), skipped("a", "y"), row("b", "x", psnr=20)])
    assert mean.methods["x"].psnr == 15
    assert "- At 0.1: mean of 2 scenes (a, b).\n" in mean_table([mean])
    assert mean.absent == ("y",)
    assert "not compared, without any result: y" in mean_table([mean])


def test_without_a_common_scene_there_is_no_mean_and_a_note():
    (mean,) = mean_rows([row("a", "x"), skipped("a", "y"), skipped("b", "x"), row("b", "y")])
    assert not mean.methods
    assert "no scene has results of all methods" in mean_table([mean])


def test_without_any_result_there_is_no_mean_and_all_scenes_are_left_out():
    (mean,) = mean_rows([skipped("a", "x"), skipped("b", "x")])
    assert (mean.scenes, mean.left_out) == ((), {"a": (), "b": ()})
    assert "- At 0.1, left out: a, without any result.\n" in mean_table([mean])


def test_a_failed_row_is_no_result_even_if_it_has_a_score():
    (mean,) = mean_rows([row("a", "x"), row("b", "x", psnr=99, status=Status.FAILED)])
    assert mean.scenes == ("a",)


def test_the_common_scenes_are_found_for_each_ratio():
    rows = [row("a", "x", 0.1), row("b", "x", 0.1), row("a", "x", 0.01), row("b", "x", 0.01)]
    rows[3] = skipped("b", "x", 0.01)
    assert [mean.scenes for mean in mean_rows(rows)] == [("a", "b"), ("a",)]


def test_views_that_a_scene_lacks_have_no_mean():
    further = (SetScore("roam 64", 4, 10.0, 5.0, 0.5),)
    (mean,) = mean_rows([row("a", further=further), row("b")])
    assert (mean.methods["x"].psnr, mean.methods["x"].further) == (20, ())


def test_the_original_model_is_in_no_mean():
    assert "Means" not in markdown([row("a", ORIGINAL, 1.0)])
    assert [mean.target.ratio for mean in mean_rows([row("a", ORIGINAL, 1.0), row("a", "x")])] == [
        0.1
    ]


def test_every_figure_has_its_mean():
    figures = {
        "psnr": (20.0, 30.0), "least_psnr": (18.0, 20.0), "ssim": (0.9, 0.5), "views": (2, 3),
        "splats": (10, 15), "file_bytes": (100, 301), "seconds": (1.0, 2.0),
        "read_seconds": (0.5, 1.0), "peak_memory": (1000, 2001), "fps": (10.0, 20.0),
        "fps_gsplat": (100.0, 300.0),
    }  # fmt: skip
    one, two = ({name: pair[side] for name, pair in figures.items()} for side in (0, 1))
    further = SetScore("roam 64", 4, 10.0, 5.0, 0.5, {"flip": 0.1})
    other = SetScore("roam 64", 6, 20.0, 7.0, 0.7, {"flip": 0.3, "lpips": 1.0})
    rows = [
        row("a", extras={"lpips": 0.2}, further=(further,), **one),
        row("b", extras={"lpips": 0.4}, further=(other,), **two),
    ]
    (mean,) = mean_rows(rows)
    found = mean.methods["x"]
    assert {name: getattr(found, name) for name in figures} == {
        "psnr": 25.0, "least_psnr": 19.0, "ssim": pytest.approx(0.7), "views": 5,
        "splats": 12, "file_bytes": 200, "seconds": 1.5, "read_seconds": 0.75,
        "peak_memory": 1500, "fps": 15.0, "fps_gsplat": 200.0,
    }  # fmt: skip
    assert found.extras == {"lpips": pytest.approx(0.3)}
    assert found.further == (
        SetScore("roam 64", 10, 15.0, 6.0, pytest.approx(0.6), {"flip": pytest.approx(0.2)}),
    )


def test_a_figure_that_a_scene_lacks_has_no_mean():
    (mean,) = mean_rows([row("a", seconds=1.0), row("b")])
    assert mean.methods["x"].seconds is None
    assert mean.methods["x"].psnr == 20


def test_photographs_and_originals_are_not_averaged_together():
    text = markdown([row("a", psnr=10), row("b", psnr=30, against=Against.PHOTOGRAPHS)])
    assert "Means over scenes, against the original model" in text
    assert "Means over scenes, against photographs" in text
    assert "20.00" not in text


# Tables


def test_equal_images_score_infinity_in_table_and_json():
    text = scene_table([row(psnr=math.inf)])
    assert "| ∞ |" in text
    assert json.loads(json_line(row(psnr=math.inf)))["psnr"] == "inf"


def test_rows_are_restored_from_their_json_lines():
    rows = [
        row("inf", "nan", psnr=math.inf, extras={"flip": 0.1}, label="-inf", notes=("inf", "n")),
        row(further=(SetScore("nan", 2, math.inf, 3.0, -math.inf, {"lpips": math.inf}),)),
        skipped("a", "y"),
    ]
    assert [BenchRow.from_dict(json.loads(json_line(each))) for each in rows] == rows
    assert rows[0].key == ("inf", "nan", (0.1, "", None))


def test_the_table_of_a_scene_has_all_columns_with_values():
    whole = row(
        splats=12345, file_bytes=1234567, seconds=1.234, peak_memory=250_400_000, psnr=20.004,
        least_psnr=18.5, ssim=0.9124, extras={"lpips": 0.1236}, fps=12.34, fps_gsplat=412.6,
    )  # fmt: skip
    two_sets = replace(whole, label="auto 64", further=(SetScore("roam 64", 1, 21.0, 17.0, 0.8),))
    text = markdown([whole, row("b", views=1)])
    assert (
        "# b\n\nAgainst the original model, 1 view.\n\n"
        "| method | ratio | splats | bytes | seconds | peak MB | PSNR | worst | SSIM | frames/s |\n"
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n"
        "| x | 0.1 | – | – | – | – | 20.00 | – | 0.900 | – |\n"  # noqa: RUF001
    ) in text
    assert scene_table([whole]) == (
        "Against the original model, 2 views.\n\n"
        "| method | ratio | splats | bytes | seconds | peak MB | PSNR | worst | SSIM | LPIPS"
        " | frames/s | gsplat frames/s |\n"
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n"
        "| x | 0.1 | 12,345 | 1,234,567 | 1.23 | 250 | 20.00 | 18.50 | 0.912 | 0.124"
        " | 12.3 | 413 |\n"
    )
    text = scene_table([two_sets])
    assert "Against the original model, 2 views (auto 64), 1 view (roam 64).\n" in text
    assert " | PSNR, roam 64 | worst, roam 64 | SSIM, roam 64 | frames/s |" in text


def test_skips_and_failures_are_visible_with_their_reason():
    failed = BenchRow("a", "z", 0.1, Status.FAILED, "boom")
    text = scene_table([row(), skipped("a", "y"), failed])
    assert "| y | 0.1 | skipped |" in text
    assert "- y at 0.1: skipped: There is no file \\| here." in text
    assert "- z at 0.1: failed: boom" in text


def test_rows_without_a_score_change_neither_headings_nor_the_number_of_views():
    scored = row(label="auto 64", further=(SetScore("roam 64", 1, 25.0, 24.0, 0.5),))
    original = row(method=ORIGINAL, ratio=1.0, psnr=None, label="auto 64")
    text = scene_table([original, skipped("a", "y"), scored])
    assert "Against the original model, 2 views (auto 64), 1 view (roam 64).\n" in text
    assert "| PSNR |" in scene_table([skipped("a", "y"), row(label="auto 64")])


def test_the_column_of_requests_is_of_sizes_or_ratios():
    assert scene_table([row()]).split("\n\n")[1].startswith("| method | ratio |")
    sized = scene_table([row(ratio=None, format=".sog", size=500_000)]).split("\n\n")[1]
    assert sized.startswith("| method | size |")


def test_tables_are_well_formed():
    rows = [row(extras={"lpips": 0.1}, fps_gsplat=100.0), skipped("a", "y"), row("b", notes=("n",))]
    parts = markdown(rows).split("\n\n")
    tables = [part.splitlines() for part in parts if part.startswith("| method")]
    assert [len(lines) for lines in tables] == [3, 4, 3]
    for lines in tables:
        assert len({line.replace("\\|", "").count("|") for line in lines}) == 1
    for column in ("LPIPS", "gsplat frames/s"):  # only in the table of the scene that has values
        assert [f"| {column} |" in lines[0] for lines in tables] == [False, True, False]


def test_ablations_are_listed_as_differences_to_the_whole_method():
    text = markdown([row(method="paper", psnr=30), row(method="paper:tau=0", psnr=29.5, ssim=0.95)])
    assert "| 0.1 | paper:tau=0 | 29.50 | 0.950 | -0.50 | +0.050 |" in text
    equal = markdown([row(method="paper", psnr=30), row(method="paper:tau=0", psnr=math.inf)])
    assert f"| ∞ | 0.900 | {NONE} | +0.000 |" in equal
    for rows in ([row(method="paper"), row(method="fast:rounds=0")], [row(method="paper:tau=0")]):
        assert "Ablations" not in markdown(rows)


def test_curves_are_sorted_by_ratio_and_leave_out_infinity():
    rows = [row(ratio=0.1, psnr=30), row(ratio=0.01, psnr=20), row(ratio=1, psnr=math.inf)]
    assert curves(rows) == {"x": [(0.01, 20), (0.1, 30)]}


@pytest.mark.parametrize("rows", [[row(), row(ratio=0.01)], [skipped("a", "x")], []])
def test_a_plot_is_drawn_even_without_results(rows):
    drawn = plot(rows)
    drawing = ET.fromstring(drawn)
    texts = [element.text for element in drawing.iter("{http://www.w3.org/2000/svg}text")]
    assert ("against the original model, mean over scenes" in texts) == bool(rows)


def test_a_plot_says_if_its_means_are_of_different_scenes():
    rows = [row(scene, method, ratio) for scene in "ab" for method in "xy" for ratio in (0.1, 0.01)]
    assert "means of" not in plot(rows)
    assert "compaction ratio; means of 2 scenes at 0.01, 1 scene at 0.1<" in plot(
        [one for one in rows if (one.scene, one.method, one.ratio) != ("b", "y", 0.1)]
    )


# The published table


def published_rows(scenes, dataset="tanks-and-temples"):
    common = {"dataset": dataset, "against": Against.PHOTOGRAPHS, "extras": {"lpips": 0.4}}
    for scene in scenes:
        yield row(scene, ORIGINAL, 1.0, 23.0, **common)
        for ratio, psnr in ((0.1, 18.0), (0.01, 15.0), (0.001, 13.0)):
            yield row(scene, "paper", ratio, psnr, seconds=10.0, **common)


def test_published_figures_are_listed_beside_ours():
    text = published_table(list(published_rows(["train", "truck"])))
    assert "18.00 / .900 / .400 / 10 s; 15.00; 13.00" in text
    assert "17.94 / .626 / .413 / 58 s; 15.29; 13.54" in text
    assert "23.00 / .900 / .400 | 23.61 / .843 / .169" in text
    assert "of 2 scenes" not in text


def test_missing_scenes_of_a_data_set_are_named():
    rows = [*published_rows(["train"]), skipped("truck", "paper")]
    rows[-1] = BenchRow(
        "truck", "paper", 0.1, Status.SKIPPED, "x", Against.PHOTOGRAPHS, "tanks-and-temples"
    )
    text = published_table(rows)
    assert "at 0.1 without truck" in text
    assert "1 of 2 scenes" in published_table(list(published_rows(["train"])))


def test_only_photographs_at_ratios_stand_beside_published_figures():
    rows = list(published_rows(["train"]))
    assert "Published protocol" in markdown(rows)
    assert "Published" not in markdown([replace(one, against=Against.ORIGINAL) for one in rows])
    assert "Published" not in markdown([*rows, replace(rows[0], format=".sog")])


def test_further_figures_are_those_of_the_first_ratio():
    rows = [
        replace(one, ssim=one.ratio, seconds=one.ratio * 100, extras={}) if one.ratio < 1 else one
        for one in published_rows(["train"])
    ]
    assert f"| 18.00 / .100 / {NONE} / 10 s; 15.00; 13.00 |" in published_table(rows[::-1])


def test_3dgs_has_no_mean_here_if_a_scene_lacks_it():
    rows = list(published_rows(["train", "truck"]))
    failed = replace(rows[0], status=Status.FAILED, psnr=None)
    assert f"| Tanks & Temples | {NONE} |" in published_table([failed, *rows[1:]])


def test_published_figures_are_formatted_as_in_the_paper():
    assert figures_cell(Figures({})) == f"{NONE}; {NONE}; {NONE}"
    figures = DATASETS["nerf-synthetic"].methods
    assert figures_cell(figures["NanoGS"]) == "25.81 / .910 / .092 / 11 s; 22.28; 19.04"
    assert figures_cell(figures["PUP"]) == "20.24; 13.26; 11.31"
    assert sum(dataset.scenes for dataset in DATASETS.values()) == 21


def test_numbers_are_formatted_with_separators_infinity_and_without_minus_zero():
    values = [1_234_567.0, -1.0, None, math.nan, math.inf, -math.inf, -0.04]
    texts = ["1,234,567.0", "-1.0", NONE, NONE, "∞", "-∞", "0.0"]
    assert [number_text(value, 1) for value in values] == texts
