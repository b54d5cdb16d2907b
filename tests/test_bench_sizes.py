"""`bench` with file sizes: gains, charts and pages of made-up rows, and the command."""

import json
import math
from dataclasses import replace
from io import BytesIO
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from PIL import Image

import launch
import nanogs
from browsers import page_at
from builders import random_splats
from nanogs.bench.gains import mean_gains
from nanogs.bench.output import ResultFolder
from nanogs.bench.rows import ORIGINAL, Against, BenchRow, BenchTarget, SetScore, Status, size_name
from nanogs.bench.settings import BenchSettings
from nanogs.bench.size_charts import SizeCharts
from nanogs.bench.size_tables import ALONE, file_table, size_page
from nanogs.bench.tables import markdown
from nanogs.errors import OptionError
from nanogs.formatting import NONE

SIZES = (250_000, 500_000, 1_000_000, 2_000_000)
SVG = "{http://www.w3.org/2000/svg}"


def rows_of(method, psnr, *, scene="a", suffix=".sog", share=1.0, sizes=SIZES, near=None):
    """Make one row for each size, with a file of `share` times that size."""
    return [
        BenchRow(
            scene, method, None, format=suffix, size=size, file_bytes=int(share * size),
            label="auto 64", psnr=value, ssim=value / 100, views=2, seconds=1.5, splats=size // 10,
            further=(SetScore("roam 64", 2, value - (near or 0), 1.0, 0.5),) if near else (),
        )
        for size, value in zip(sizes, psnr, strict=True)
    ]  # fmt: skip


BASE = (24.0, 27.5, 30.2, 32.0)


def base_plus(gain):
    return [value + gain for value in BASE]


def the_only(gains, **names):
    [found] = [
        gain
        for gain in gains
        if all(getattr(gain.first, name) == value for name, value in names.items())
    ]
    return found


# Gains


def test_two_decibels_more_at_every_size_are_a_gain_of_two():
    [gain] = mean_gains([*rows_of("them", BASE), *rows_of("ours", base_plus(2))], ["them"])
    assert (gain.first.method, gain.first.anchor) == ("ours", "them")
    assert gain.psnr == gain.least_psnr == pytest.approx(2)
    assert gain.ssim == pytest.approx(0.02)
    assert gain.rate < -0.3


def test_half_the_bytes_are_a_rate_of_minus_half():
    rows = [*rows_of("ours", BASE, share=0.5), *rows_of("them", BASE)]
    [gain] = mean_gains(rows, ["them"])
    assert gain.rate == pytest.approx(-0.5)
    assert " | -50 % | 1 |\n" in markdown(rows, others=["them"])
    assert ">-50 %<" in size_page(rows, ["them"], "")


def test_one_method_alone_has_no_gain_and_the_tables_say_so():
    rows = rows_of("ours", BASE)
    assert ALONE in markdown(rows).split("# ")[1]
    page = size_page(rows, [], "")
    assert ALONE in page
    assert "BD-PSNR" not in markdown(rows) + page


def test_a_gain_is_the_mean_over_scenes_with_the_smallest_beside_it():
    rows = [row for scene in "ab" for row in rows_of("them", BASE, scene=scene)]
    rows += [*rows_of("ours", base_plus(4), scene="a"), *rows_of("ours", BASE, scene="b")]
    [gain] = mean_gains(rows, ["them"])
    assert (gain.psnr, gain.least_psnr) == (pytest.approx(2), 0)
    assert "| ours | them | .sog | auto 64 | +2.00 (+0.00) | +0.020 |" in markdown(
        rows, others=["them"]
    )


def test_a_rate_that_some_scenes_lack_gives_the_number_of_scenes():
    rows = [row for scene in "abcd" for row in rows_of("them", BASE, scene=scene)]
    rows += [row for scene in "ac" for row in rows_of("ours", base_plus(1), scene=scene)]
    rows += rows_of("ours", base_plus(50), scene="b")
    assert " % (of 2) | 3 |" in markdown(rows, others=["them"])


def test_failed_rows_and_infinite_psnr_are_left_out_of_curves():
    rows = [*rows_of("them", BASE), *rows_of("ours", base_plus(2))]
    failed = BenchRow("a", "ours", None, Status.FAILED, "boom", format=".sog", size=4_000_000)
    equal = [replace(row, psnr=math.inf) for row in rows_of("ours", BASE[:1], sizes=[8_000_000])]
    [gain] = mean_gains([*rows, failed, *equal], ["them"])
    assert gain.psnr == pytest.approx(2)


def test_two_requests_that_gave_files_of_the_same_bytes_count_once():
    rows = [*rows_of("them", BASE), *rows_of("ours", base_plus(2))]
    again = replace(rows[-1], size=4_000_000)
    worse = replace(rows[-1], size=8_000_000, psnr=rows[-1].psnr - 5)
    [gain] = mean_gains([*rows, again, worse], ["them"])
    assert gain.psnr == pytest.approx(2)


def test_against_several_methods_the_best_at_each_size_counts():
    one, two = [20, 27.5, 20, 32.0], [24.0, 20, 30.2, 20]
    rows = [*rows_of("one", one), *rows_of("two", two), *rows_of("ours", base_plus(2))]
    # The best, not the largest.
    rows = [replace(row, file_bytes=row.size + (1000 if row.psnr == 20 else 0)) for row in rows]
    gains = mean_gains(rows, ["one", "two"])
    assert [gain.first.anchor for gain in gains] == ["one", "two", "one, two"]
    assert gains[2].psnr == pytest.approx(2)
    assert gains[0].psnr > 3


def test_without_other_methods_gains_are_against_the_first():
    rows = [*rows_of("fast", BASE), *rows_of("best", base_plus(1))]
    assert [gain.first.anchor for gain in mean_gains(rows)] == ["fast"]


def test_each_format_and_each_set_of_views_has_its_own_gain():
    rows = [*rows_of("them", BASE, near=1), *rows_of("ours", base_plus(2), near=4)]
    rows += [*rows_of("them", BASE, suffix=".spz"), *rows_of("ours", base_plus(5), suffix=".spz")]
    gains = mean_gains(rows, ["them"])
    assert the_only(gains, format=".sog", label="auto 64").psnr == pytest.approx(2)
    assert the_only(gains, format=".sog", label="roam 64").psnr == pytest.approx(-1)
    assert the_only(gains, format=".spz", label="auto 64").psnr == pytest.approx(5)


def test_gains_on_photographs_are_named_so():
    rows = [*rows_of("them", BASE), *rows_of("ours", base_plus(2))]
    text = markdown([replace(row, label="", against=Against.PHOTOGRAPHS) for row in rows])
    assert "| ours | them | .sog | photographs | +2.00 (+2.00) |" in text
    assert "Published" not in text
    failing = [*rows_of("them", BASE), *rows_of("ours", BASE[:1], sizes=SIZES[:1])]
    text = markdown([replace(row, label="", against=Against.PHOTOGRAPHS) for row in failing])
    why = "no figures, because they need at least two sizes of each method (a)."
    assert f"- ours against them, .sog: {why}\n" in text


@pytest.mark.parametrize(
    ("ours", "explanation"),
    [
        (
            rows_of("ours", BASE[:1], sizes=SIZES[:1]),
            "no figures, because they need at least two sizes of each method (a).",
        ),
        (
            [
                replace(row, file_bytes=400_000)
                for row in rows_of("ours", BASE[:2], sizes=SIZES[:2])
            ],
            "no figures, because they need at least two sizes of each method (a).",
        ),
        (
            [replace(row, status=Status.FAILED) for row in rows_of("ours", BASE)],
            "no figures, because they need at least two sizes of each method (a).",
        ),
        (rows_of("ours", BASE, share=0.01), "the curves share no sizes (a)."),
        (rows_of("ours", base_plus(50)), "the curves share no PSNRs (a)."),
        (
            rows_of("ours", (30, 29, 31, 32)),
            "no BD-rate, because a larger file has a lower PSNR (a).",
        ),
        (
            rows_of("ours", (30, 29, 31, 32), share=0.01),
            "no BD-rate, because a larger file has a lower PSNR (a).",
        ),
    ],
)
def test_a_missing_figure_is_explained_in_table_and_page(ours, explanation):
    rows = [*rows_of("them", BASE), *ours]
    [gain] = mean_gains(rows, ["them"])
    assert None in (gain.psnr, gain.rate)
    for text in (markdown(rows, others=["them"]), size_page(rows, ["them"], "")):
        assert f"ours against them, .sog, auto 64: {explanation}" in " ".join(text.split("\n"))
        assert "(of 0)" not in text


# Rows, charts, pages


def test_sizes_have_names_that_are_valid_in_file_names():
    assert [size_name(size) for size in (500_000, 1_048_576, 20_000_000, 1)] == [
        "0.5MB", "1.048576MB", "20MB", "0.000001MB",
    ]  # fmt: skip
    assert BenchTarget(None, ".sog", 500_000).text == "0.5MB .sog"
    assert BenchTarget(1.0, ".sog").text == "whole .sog"
    assert BenchTarget(0.1).text == "0.1"


def test_rows_of_an_interrupted_run_are_kept(tmp_path):
    first, second, third = rows_of("fast", BASE[:3], sizes=SIZES[:3])
    unfinished = ResultFolder(tmp_path, run="this")
    unfinished.add(first)
    unfinished.add(second)
    again = ResultFolder(tmp_path, run="this")
    assert again.done == [first, second]
    again.add(first)
    again.add(third)
    assert ResultFolder(tmp_path, run="this").done == [first, second, third]


def test_a_chart_for_the_mean_and_each_scene_has_every_point():
    rows = [
        row
        for scene, offset in (("a", 0), ("b", 4))
        for method, gain in (("them", 0), ("ours", 2))
        for row in rows_of(method, base_plus(offset + gain), scene=scene, near=1, share=0.9)
    ]
    charts = SizeCharts(rows)
    assert [chart.title for chart in charts.charts] == [
        f"{name}, .sog, {label}"
        for name in ("mean over scenes", "a", "b")
        for label in ("auto 64", "roam 64")
    ]
    assert charts.charts[0].lines["ours"] == [
        (0.9 * size / 1e6, pytest.approx(value + 4))
        for size, value in zip(SIZES, BASE, strict=True)
    ]
    drawing = ET.fromstring(charts.svg())
    assert len(list(drawing.iter(f"{SVG}polyline"))) == 6 * 2
    dots = len(list(drawing.iter(f"{SVG}circle")))
    assert dots == 6 * 2 * (len(SIZES) + 1)  # one more in the legend
    transforms = {group.get("transform") for group in drawing if group.get("transform")}
    assert len(transforms) == 6


def test_scenes_with_and_without_photographs_have_means_of_their_own():
    rows = rows_of("ours", BASE, scene="a", near=1)
    photographs = [
        replace(row, scene="b", label="", further=(), against=Against.PHOTOGRAPHS)
        for row in rows_of("ours", base_plus(3))
    ]
    charts = SizeCharts([*rows, *photographs]).charts
    means = {chart.title: chart.lines for chart in charts if chart.title.startswith("mean")}
    values = {name: [psnr for _, psnr in lines.get("ours", [])] for name, lines in means.items()}
    assert values["mean over scenes against the original model, .sog, auto 64"] == list(BASE)
    assert values["mean over scenes against photographs, .sog"] == list(base_plus(3))


def test_no_chart_is_without_points():
    """Neither for the original, which is measured against photographs, nor for other views."""
    photographs = [
        replace(row, scene="b", label="", further=(), against=Against.PHOTOGRAPHS)
        for row in rows_of("ours", base_plus(3))
    ]
    original = replace(photographs[0], method=ORIGINAL, format="", size=None)
    charts = SizeCharts([original, *photographs])
    assert [chart.title for chart in charts.charts] == ["b, .sog"]
    assert charts.columns == 1
    charts = SizeCharts([original, *photographs, *rows_of("ours", BASE, scene="a", near=1)])
    assert all(chart.lines["ours"] for chart in charts.charts)
    assert (len(charts.charts), charts.columns) == (2 * (1 + 2), 2)


def test_the_picture_shows_the_points_in_the_colours_of_the_page():
    rows = [*rows_of("them", BASE), *rows_of("ours", base_plus(2))]
    charts = SizeCharts(rows)
    pixels = np.asarray(Image.open(BytesIO(charts.png())).convert("RGB")).reshape(-1, 3)
    for colour in ((0x1F, 0x77, 0xB4), (0xFF, 0x7F, 0x0E)):
        assert f"#{bytes(colour).hex()}" in charts.svg()
        assert (pixels == colour).all(axis=1).sum() > 300
    assert not (pixels == (0x2C, 0xA0, 0x2C)).all(axis=1).any()


@pytest.mark.parametrize("sizes", [(59_000, 119_000), (101_000, 104_000), (2000, 9_000_000)])
def test_the_picture_has_the_ticks_of_the_drawing(monkeypatch, sizes):
    """Where only a power of ten had a label, nobody could read the other sizes."""
    rows = rows_of("ours", (24.0, 30.0), sizes=sizes)
    labels = []

    def savefig(figure, *_args, **_options):
        figure.draw_without_rendering()
        [axes] = figure.axes
        low, high = axes.get_xlim()
        labels.extend(
            text.get_text()
            for text in axes.get_xticklabels(which="both")
            if text.get_text() and low <= text.get_position()[0] <= high
        )

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)
    charts = SizeCharts(rows)
    charts.png()
    assert len(labels) > 1
    assert all(f">{label}<" in charts.svg() for label in labels)


def test_names_in_the_picture_are_not_read_as_formulas():
    """Matplotlib reads text between two dollar signs as a formula; these would be invalid."""
    rows = rows_of("$_$", BASE, scene="a $b_c_d$")
    assert SizeCharts(rows).png().startswith(b"\x89PNG")


def test_names_are_escaped_in_the_page():
    rows = [*rows_of("<them>", BASE), *rows_of("ours", base_plus(2))]
    page = size_page(rows, ["<them>"], "- seconds: of the\n  method <x>")
    assert "<them>" not in page
    assert "&lt;them&gt;" in page
    assert "- seconds: of the method &lt;x&gt;" in page


@pytest.mark.filterwarnings("default")  # warnings of the browser's driver
def test_each_chart_of_the_page_fits_a_phone_with_its_legend(tmp_path):
    rows = [*rows_of("them", BASE, near=1), *rows_of("ours", base_plus(2), near=1)]
    command = f"nanogs bench {'x' * 100}.ply"
    (tmp_path / "a.html").write_text(size_page(rows, ["them"], command), encoding="utf-8")
    with page_at((tmp_path / "a.html").as_uri(), 390, 844) as page:
        boxes = [svg.bounding_box() for svg in page.locator("svg").all()]
        assert len(boxes) == 2
        assert all(box["x"] + box["width"] <= 390 for box in boxes)
        assert page.evaluate("document.documentElement.scrollWidth") == 390


@pytest.mark.filterwarnings("default")  # warnings of the browser's driver
def test_the_page_can_be_read_on_a_phone_and_in_the_dark(tmp_path):
    rows = [*rows_of("them", BASE, near=1), *rows_of("ours", base_plus(2), near=1)]
    command = f"nanogs bench {'x' * 20}.ply --sizes-of-files 1MB --methods ours"
    (tmp_path / "a.html").write_text(size_page(rows, ["them"], command), encoding="utf-8")
    with page_at((tmp_path / "a.html").as_uri(), 360, 740) as page:
        heights = page.locator("svg text").evaluate_all(
            """texts => texts.filter((text) => text.textContent).map((text) => {
                const { b, d } = text.getScreenCTM();
                return text.getBBox().height * Math.hypot(b, d);
            })"""
        )
        assert min(heights) > 12  # pixels
        lines = "option => option.getClientRects().length"
        assert page.locator("pre .option").count() == 2
        assert all(part.evaluate(lines) == 1 for part in page.locator("pre .option").all())
        assert page.get_by_role("figure").count() == 2
        page.emulate_media(color_scheme="dark")
        colour = "part => getComputedStyle(part).%s"
        for selector in ("body", "svg text", "td"):
            assert page.locator(selector).first.evaluate(colour % "color") == "rgb(232, 232, 230)"
        assert page.locator("svg > rect").first.evaluate(colour % "fill") == "none"
        assert page.locator("body").evaluate(colour % "backgroundColor") == "rgb(19, 20, 22)"


def test_results_of_a_scene_whose_name_is_no_utf8_are_written(tmp_path):
    ResultFolder(tmp_path).finish(rows_of("ours", BASE, scene="a\udcff"))
    for name in ("results.md", "results.html", "plot.svg"):
        assert "a\\udcff" in (tmp_path / name).read_text(encoding="utf-8")
    line = (tmp_path / "results.jsonl").read_text(encoding="utf-8").splitlines()[0]
    assert json.loads(line)["scene"] == "a\udcff"


def test_the_table_of_files_has_the_numbers_of_each_file():
    rows = rows_of("ours", (24.0, math.inf), sizes=(250_000, 1_234_567), near=3)
    rows.append(BenchRow("a", "ours", None, Status.FAILED, "boom", format=".sog", size=5))
    rows.append(BenchRow("a", ORIGINAL, 1.0, psnr=40.0, ssim=1.0, label="auto 64"))
    table = file_table(rows)
    assert table.head == (
        "scene", "method", "size", "bytes", "splats", "seconds",
        "PSNR auto 64", "SSIM auto 64", "PSNR roam 64", "SSIM roam 64",
    )  # fmt: skip
    assert table.rows == [
        [
            "a",
            "ours",
            "0.25MB .sog",
            "250,000",
            "25,000",
            "1.5",
            "24.00",
            "0.240",
            "21.00",
            "0.500",
        ],
        ["a", "ours", "1.234567MB .sog", "1,234,567", "123,456", "1.5", *[NONE] * 4],
    ]
    assert table.left == 3


def test_a_page_is_written_even_if_nothing_was_measured(tmp_path):
    rows = [
        BenchRow("a", "fast", None, Status.FAILED, "boom", format=".sog", size=size)
        for size in SIZES
    ]
    rows[1] = replace(rows[1], status=Status.SKIPPED, reason="too large")
    ResultFolder(tmp_path).finish(rows)
    page = (tmp_path / "results.html").read_text(encoding="utf-8")
    assert "a, fast at 0.25MB .sog: failed: boom" in page
    assert "a, fast at 0.5MB .sog: skipped: too large" in page
    with Image.open(tmp_path / "plot.png") as picture:
        assert picture.size[0] > 100


# Settings


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"file_sizes": (0,)}, "at least 1 byte"),
        ({"file_sizes": (5, 5)}, "The size .* occurs twice"),
        ({"formats": (".sog", ".sog")}, "The format .* occurs twice"),
        ({"formats": (".html",)}, "writes and reads"),
        ({"formats": (".meta.json",)}, "writes and reads"),
        ({"formats": (".obj",)}, r"^nanogs does not write a format '\.obj'"),
        ({"methods": ("random",)}, "random cannot make a file of a given size"),
        ({"methods": ("paper",)}, "choose another preset"),
        ({"formats": (".sog", ".spz"), "externals": {"x": "{scene}_{size}"}}, "need {format}"),
    ],
)
def test_invalid_sizes_formats_and_methods_are_refused(options, message):
    with pytest.raises(OptionError, match=message):
        BenchSettings(**{"file_sizes": (1000,), "methods": ("fast",)} | options)


# The command


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("sizes") / "ball.ply"
    splats = random_splats(1500, degree=0)
    splats.opacity_logits[:] = 2
    nanogs.save(splats, path)
    return path


@pytest.fixture(scope="module")
def measured(model):
    """The JSON output and the folder of a run that also compares files of another tool."""
    folder = model.parent
    whole = nanogs.load(model)
    for count, size in ((150, "0.005MB"), (400, "0.01MB")):
        nanogs.save(whole.take(np.arange(count)), folder / f"ball_{size}_them.splat")
        (folder / f"ball_{size}_them.splat.json").write_text('{"seconds": 4.5}')
    result = launch.run(
        "bench", model, "--sizes-of-files", "10kB,5kB,1MB", "--format", "splat",
        "--methods", "fast",
        "--external", f"them={folder}/{{scene}}_{{size}}_them.{{format}}", "--pixels", "48",
        "--views", "2", "--out", folder / "out", "--json", timeout=300,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout), folder / "out"


def row_of(rows, method, size):
    [found] = [row for row in rows if (row["method"], row["size"]) == (method, size)]
    return found


@pytest.mark.slow
def test_files_of_each_size_are_scored_as_they_are_read_back(measured, model, tmp_path):
    rows = measured[0]["rows"]
    small, large = row_of(rows, "fast", 5000), row_of(rows, "fast", 10_000)
    assert small["file_bytes"] <= 5000 < large["file_bytes"] <= 10_000
    assert small["psnr"] < large["psnr"]
    assert [one["label"] for one in large["further"]] == ["roam 48"]
    file = tmp_path / "small.splat"
    nanogs.simplify_blocks(model, file, size=10_000, preset="fast")
    again = nanogs.compare(nanogs.load(model), nanogs.load(file), views=2, pixels=48)
    assert large["psnr"] == pytest.approx(again.models[0].psnr, abs=1e-4)
    assert large["splats"] == len(nanogs.load(file))
    assert large["seconds"] > 0


@pytest.mark.slow
def test_a_size_that_the_whole_model_fits_into_is_skipped_with_the_reason(measured):
    rows = measured[0]["rows"]
    wholes = [row for row in rows if row["method"] == ORIGINAL]
    assert [row["format"] for row in wholes] == ["", ".splat"]
    assert wholes[1]["file_bytes"] == 1500 * 32
    assert row_of(rows, "fast", 1_000_000)["reason"] == (
        "The whole model as .splat takes 48,000 B, which fits into this size."
    )


@pytest.mark.slow
def test_files_of_another_tool_are_compared_with_ours(measured):
    data, out = measured
    them = row_of(data["rows"], "them", 5000)
    assert (them["splats"], them["file_bytes"], them["seconds"]) == (150, 4800, 4.5)
    assert (
        row_of(data["rows"], "them", 10_000)["notes"][0] == "12,800 B, above the 10,000 B asked for"
    )
    missing = row_of(data["rows"], "them", 1_000_000)
    assert missing["reason"].endswith("ball_1MB_them.splat.")
    gains = {gain["gains"][0]["label"]: gain for gain in data["gains"]}
    assert set(gains) == {"auto 48", "roam 48"}
    assert gains["auto 48"]["psnr"] > 0.5
    assert gains["auto 48"]["gains"][0]["scene"] == "ball"
    assert f"{gains['auto 48']['psnr']:+.2f} (" in (out / "results.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_folder_has_a_page_and_charts_with_all_points(measured):
    _, out = measured
    assert {path.name for path in out.iterdir()} == {
        "results.md", "results.jsonl", "results.html", "plot.svg", "plot.png", "run.json",
    }  # fmt: skip
    drawing = ET.parse(out / "plot.svg").getroot()
    texts = {element.text for element in drawing.iter(f"{SVG}text")}
    assert {"ball, .splat, auto 48", "ball, .splat, roam 48", "fast", "them", "MB"} <= texts
    lines = [line.get("points").split() for line in drawing.iter(f"{SVG}polyline")]
    assert [len(points) for points in lines] == [2, 2, 1] * 2  # fast, them, the whole model
    assert "<polyline" in (out / "results.html").read_text(encoding="utf-8")
    with Image.open(out / "plot.png") as picture:
        assert picture.format == "PNG"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--sizes-of-files", "0.5MB,huge"), "'huge'"),
        (("--sizes-of-files", "0MB"), "at least 1 byte"),
        (("--sizes-of-files", "1MB,1000kB"), "The size '1MB' occurs twice"),
        (("--sizes-of-files", ","), "at least one size"),
        (("--sizes-of-files", "1MB", "--format", "obj"), ".obj"),
        (("--sizes-of-files", "1MB", "--format", ","), "at least one format"),
        (("--sizes-of-files", "1MB", "--format", "html"), "writes and reads"),
        (
            ("--sizes-of-files", "1MB", "--methods", "voxel"),
            "voxel cannot make a file of a given size",
        ),
        (("--sizes-of-files", "1MB", "--ratios", "0.1"), "not both"),
        (("--sizes-of-files", "1MB", "--external", "x=a_{ratio}.sog"), "{size}"),
        (("--format", "sog"), "--sizes-of-files"),
    ],
)
def test_invalid_sizes_and_formats_are_refused_in_one_sentence(model, options, message):
    result = launch.run("bench", model, *options)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1, result.stderr
    assert message in result.stderr


def test_a_missing_package_is_named_with_the_command_that_installs_it(model, monkeypatch, capfd):
    monkeypatch.setitem(__import__("sys").modules, "scipy.interpolate", None)
    assert launch.run_here("bench", model, "--sizes-of-files", "5kB", "--methods", "fast") == 2
    assert 'pip install "nanogs[bench]"' in capfd.readouterr().err
