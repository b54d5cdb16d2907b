"""Line charts as SVG."""

from itertools import pairwise
from xml.etree import ElementTree as ET

import pytest

from nanogs.charts import Chart, narrow_svg, svg

SVG = "{http://www.w3.org/2000/svg}"


def drawn(*charts):
    return ET.fromstring(svg(charts))


def texts(element):
    return [found.text for found in element.iter(f"{SVG}text")]


def points(element):
    """Return the points of each line, in pixels from the upper left corner of the axes."""
    return [
        [tuple(map(float, pair.split(","))) for pair in line.get("points").split()]
        for line in element.iter(f"{SVG}polyline")
    ]


def test_points_are_placed_by_log_of_count_and_psnr_in_any_order():
    line = [(100.0, 30.0), (1.0, 10.0), (10.0, 25.0)]
    [positions] = points(drawn(Chart("", "splats", {"x": line})))
    across, down = zip(*positions, strict=True)
    assert across[1] - across[0] == pytest.approx(across[2] - across[1], abs=0.2)
    assert (down[0] - down[1]) / (down[1] - down[2]) == pytest.approx(15 / 5, rel=0.01)
    assert 0 < across[0] < across[2] < 440
    assert 300 > down[0] > down[2] > 0


def test_tick_labels_are_at_the_positions_of_their_values():
    drawing = drawn(Chart("", "splats", {"x": [(1000.0, 20.0), (100_000.0, 40.0)]}))
    [[(left, low), (right, high)]] = points(drawing)
    labels = {found.text: found for found in drawing.iter(f"{SVG}text")}
    assert float(labels["1,000"].get("x")) == pytest.approx(left, abs=0.1)
    assert float(labels["100,000"].get("x")) == pytest.approx(right, abs=0.1)
    assert float(labels["20"].get("y")) == pytest.approx(low + 4, abs=0.1)
    assert float(labels["40"].get("y")) == pytest.approx(high + 4, abs=0.1)


@pytest.mark.parametrize("line", [
    [(0.001, 13.27), (0.1, 13.28)], [(5.0, 30.0)], [(1.0, -5.0), (1e7, 1e5)],
    [(3.0, 30.0), (4.0, 32.0)], [(2.05, 30.0), (9.9, 32.0)], [(1.0, 30.0), (1.01, 32.0)],
])  # fmt: skip
def test_each_axis_has_a_few_ticks_at_round_values(line):
    drawing = drawn(Chart("", "splats", {"x": line}))
    grid_lines = [found.get("d") for found in drawing.iter(f"{SVG}path")][1:]
    vertical = [float(grid_line[1:].split()[0]) for grid_line in grid_lines if "V" in grid_line]
    horizontal = [
        float(grid_line.split()[1].split("H")[0]) for grid_line in grid_lines if "H" in grid_line
    ]
    assert len(vertical) + len(horizontal) == len(grid_lines)
    assert 2 <= len(vertical) <= 9
    assert 3 <= len(horizontal) <= 7
    assert 0 <= min(vertical) < max(vertical) <= 440
    assert 0 <= min(horizontal) < max(horizontal) <= 300
    numbers = texts(drawing)[3 : 3 + len(grid_lines)]
    assert max(len(number.strip("0-").replace(",", "")) for number in numbers) <= 8


@pytest.mark.parametrize("draw", [lambda chart: svg([chart]), narrow_svg])
@pytest.mark.parametrize("line", [
    [(100_000.0, 20.0), (10_000_000.0, 40.0)], [(1_100_000.0, 20.0), (2_100_000.0, 40.0)],
    [(20_000.0, 20.0), (3_000_000.0, 40.0)], [(0.04, 20.0), (5.0, 40.0)],
])  # fmt: skip
def test_labels_of_the_horizontal_axis_do_not_touch(draw, line):
    """As 8 pixels for a digit: two numbers side by side would be read as one."""
    drawing = ET.fromstring(draw(Chart("", "splats", {"x": line})))
    labels = [
        found
        for found in drawing.iter(f"{SVG}text")
        if found.get("text-anchor") == "middle" and (found.text or "")[:1].isdigit()
    ]
    ends = [
        (float(found.get("x")) - half, float(found.get("x")) + half)
        for found in labels
        for half in [4 * sum(letter.isdigit() or 0.5 for letter in found.text)]
    ]
    assert len(ends) >= 2
    assert all(before[1] < after[0] for before, after in pairwise(ends))


@pytest.mark.parametrize("draw", [lambda chart: svg([chart]), narrow_svg])
@pytest.mark.parametrize("difference", [0.0, 0.0023, 0.04, 0.9])
def test_labels_of_the_psnr_axis_leave_room_for_its_title(draw, difference):
    lines = {"a": [(500.0, 48.3332)], "b": [(30_000.0, 48.3332 + difference)]}
    drawing = ET.fromstring(draw(Chart("", "splats", lines)))
    labels = [found.text for found in drawing.iter(f"{SVG}text") if found.get("x") == "-9.0"]
    assert len(labels) >= 3
    assert max(map(len, labels)) <= 5


def test_a_narrow_chart_has_its_legend_below_its_axis_and_no_title():
    lines = {f"line {number}": [(1.0, 2.0 + number)] for number in range(5)}
    drawing = ET.fromstring(narrow_svg(Chart("title", "MB", lines)))
    assert int(drawing.get("width")) == 350
    assert "title" not in texts(drawing)
    [chart] = [group for group in drawing if group.get("transform")]
    _, top = map(int, chart.get("transform").removeprefix("translate(").strip(")").split())
    placed = {found.text: float(found.get("y")) for found in drawing.iter(f"{SVG}text")}
    names = [placed[name] for name in lines]
    assert names == sorted(set(names))
    assert placed["MB"] < min(names)
    assert top + max(names) + 5 < int(drawing.get("height"))


def test_a_page_can_give_a_chart_its_own_colours():
    """The background is the only `rect` of the element, and nothing else is white or black."""
    drawing = drawn(Chart("", "splats", {"x": [(1.0, 2.0), (10.0, 3.0)]}))
    assert [child.get("fill") for child in drawing if child.tag == f"{SVG}rect"] == ["#fff"]
    assert (drawing.get("color"), drawing.get("fill")) == ("#222", "currentColor")
    strokes = {part.get("stroke") for part in drawing.iter(f"{SVG}path")} - {None}
    assert strokes == {"currentColor"}


def test_names_are_shown_in_the_chart_and_escaped():
    drawing = drawn(
        Chart("<b>", "splats", {"a & b": [(1.0, 2.0)], "c": []}), Chart("d", "ratio", {})
    )
    assert {"<b>", "a & b", "c", "d", "ratio"} <= set(texts(drawing))
    assert len(list(drawing.iter(f"{SVG}g"))) >= 2


def test_the_legend_has_a_dot_of_each_colour_before_its_name():
    drawing = drawn(Chart("", "splats", {"a": [(1.0, 2.0)], "b": [], "c": []}))
    lines = [group for group in drawing.iter(f"{SVG}g") if group.get("fill", "").startswith("#")]
    dots = [list(group.iter(f"{SVG}circle"))[-1] for group in lines]
    names = {found.text: found for found in drawing.iter(f"{SVG}text")}
    across, up = names["splats"], names["PSNR (dB)"]
    assert (float(across.get("x")), float(across.get("y"))) == (220, 344)
    assert (float(up.get("x")), float(up.get("y"))) == (0, 0)  # relative to a rotated group
    assert len({group.get("fill") for group in lines}) == 3
    assert [float(dot.get("cy")) for dot in dots] == [8, 28, 48]
    for dot, name in zip(dots, "abc", strict=True):
        assert float(dot.get("cx")) == 456  # right of the axes
        assert float(names[name].get("x")) == float(dot.get("cx")) + 10
        assert float(names[name].get("y")) == float(dot.get("cy")) + 4


def test_each_of_many_lines_has_a_place_in_the_legend_and_a_dot_of_its_own():
    lines = {f"line {number}": [(1.0, 2.0 + number)] for number in range(40)}
    drawing = drawn(Chart("", "splats", lines), Chart("", "splats", {}))
    groups = [group for group in drawing.iter(f"{SVG}g") if group.get("fill", "").startswith("#")]
    shapes = [list(group)[-1] for group in groups]
    kinds = {
        (group.get("fill"), shape.tag, (shape.get("d") or "").partition("m")[2])
        for group, shape in zip(groups, shapes, strict=True)
    }
    assert len(kinds) == 40
    assert all(len(group) == 3 for group in groups)  # line, dot, and dot of the legend
    names = [found for found in drawing.iter(f"{SVG}text") if (found.text or "").startswith("line")]
    heights = [float(name.get("y")) for name in names]
    assert len(set(heights)) == 40
    assert 40 + max(heights) + 5 < int(drawing.get("height"))


def test_a_long_name_is_shortened_in_the_middle_and_whole_in_a_tooltip():
    long = "a & very long name of a model/iteration_30000.ply"
    drawing = drawn(Chart("", "splats", {long: [(1.0, 2.0)], "short": []}))
    [shortened] = [
        found for found in drawing.iter(f"{SVG}text") if found.find(f"{SVG}title") is not None
    ]
    assert shortened.text == "a & very lo…n_30000.ply"
    assert shortened.find(f"{SVG}title").text == long
    assert "short" in texts(drawing)


@pytest.mark.parametrize(
    ("count", "columns", "size"),
    [(0, None, (700, 400)), (3, None, (2100, 400)), (3, 2, (1400, 800)), (4, 2, (1400, 800))],
)
def test_charts_are_laid_out_in_rows_within_the_drawing(count, columns, size):
    drawing = ET.fromstring(svg([Chart("", "x", {})] * count, columns))
    assert (int(drawing.get("width")), int(drawing.get("height"))) == size
    assert drawing.get("viewBox") == f"0 0 {size[0]} {size[1]}"
    transforms = [group.get("transform") for group in drawing if group.get("transform")]
    corners = [(70, 40), (770, 40), (70, 440), (770, 440)]
    if columns is None:
        corners = [(70, 40), (770, 40), (1470, 40)]
    assert transforms == [f"translate({x} {y})" for x, y in corners[:count]]


def test_no_charts_give_an_empty_drawing():
    assert points(drawn()) == []
