"""The page of `nanogs studio` in a real browser, with a fake server that the tests control."""

import contextlib
import io
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import nanogs
from browsers import CHROMIUM, browser, without_errors
from builders import solid
from fake_studio import LAYOUT, running_fake
from nanogs.pipeline.stages import STAGES
from viewer_bundle import require_bundle

pytestmark = [
    pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed"),
    pytest.mark.filterwarnings("default"),  # the driver's own warnings are not ours
]
TIMEOUT = 60_000  # milliseconds; test machines may be busy
BARE = (
    "#view > :not(canvas), .over, #legend { opacity: 0 !important; }"
    " canvas { outline: none !important; }"
)
MODELS = {
    "original": solid((1, 0, 0)),
    "magenta": solid((1, 0, 1)),
    "blue": solid((0, 0, 1)),
    "green": solid((0, 0.8, 0)),
}
RED, BLUE, GREEN, MAGENTA = (1, 0, 0), (0, 0, 1), (0, 0.8, 0), (1, 0, 1)
AMBER = (1, 197 / 255, 61 / 255)
POINTS = [(150, 4000, 40.0), (60, 1600, 34.0), (15, 400, 26.0)]


@pytest.fixture(scope="module")
def chromium():
    require_bundle()
    with browser() as started:
        yield started


class Studio:
    """A page and the fake server that it talks to."""

    def __init__(self, page, fake):
        self.page, self.fake = page, fake

    def wait_for_state(self, name, number=None):
        numbered = "" if number is None else f'[data-number="{number}"]'
        self.page.wait_for_selector(f"body[data-state={name}]{numbered}", timeout=TIMEOUT)

    def pixels(self):
        """Return the pixels of the models alone once nothing moves, (H, W, 3) float32."""
        self.page.wait_for_selector("#view[data-state=still]", timeout=TIMEOUT)
        picture = self.page.locator("#view canvas").screenshot(style=BARE)
        return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"), dtype=np.float32) / 255

    def share_of_colour(self, color, side):
        """Return the share of one half of the picture that has about this colour."""
        pixels = self.pixels()
        half = pixels.shape[1] // 2
        part = pixels[:, :half] if side == "left" else pixels[:, half:]
        return float((np.abs(part - color).max(axis=-1) < 0.2).mean())

    def wait_until(self, condition):
        """Wait until the condition holds; an input takes time to arrive."""
        end = time.monotonic() + TIMEOUT / 2000
        while not condition():
            assert time.monotonic() < end, "it did not become what it should be"
            self.page.wait_for_timeout(50)

    def wait_for_colour(self, color, side):
        self.wait_until(lambda: self.share_of_colour(color, side) > 0.05)

    def answer_request(self, model="blue", **more):
        """Answer the latest request, and wait until the page shows the answer."""
        number = self.fake.requests[-1][1]["number"]
        self.fake.send_result("draft", number, model, **more)
        self.fake.send_result("measured", number, model, **more)
        self.wait_for_state("measured", number)

    def latest_choice(self):
        return [body["choice"] for path, body in self.fake.requests if path == "ask"][-1]

    def choice_of_request(self, count):
        return self.fake.wait("ask", count)["choice"]


@pytest.fixture(scope="module")
def tab(chromium):
    """A tab in which pages follow each other, which saves about a second for each."""
    context = chromium.new_context()
    yield context.new_page()
    context.close()


@contextlib.contextmanager
def opened(tab, width=800, height=540, answered=True):
    """Open a page, by default with its first request answered; errors on it fail the test."""
    with running_fake(MODELS) as (fake, address), without_errors(tab):
        tab.set_viewport_size({"width": width, "height": height})
        studio = Studio(tab, fake)
        tab.goto(address)
        fake.wait("ask")
        if answered:
            studio.answer_request()
            for splats, size, psnr in POINTS:
                fake.send_event(
                    type="point", splats=splats, bytes=size, psnr=psnr, kind="coarse", format=".sog"
                )
            tab.wait_for_function(
                "document.querySelectorAll('#plot .point').length === 3", timeout=TIMEOUT
            )
        yield studio
        tab.evaluate("sessionStorage.clear()")  # a later server may have the same port
        tab.goto("about:blank")
        tab.mouse.move(0, 0)


@pytest.fixture
def studio(tab):
    with opened(tab) as page:
        yield page


def test_a_draft_is_shown_before_the_measured_result(tab):
    with opened(tab, answered=False) as studio:
        studio.wait_for_colour(RED, "left")
        assert studio.page.get_attribute("body", "data-state") == "opening"
        ask = studio.fake.wait("ask")
        assert ask["choice"]["wish"] == {"splats": 30}
        assert ask["choice"]["format"] == ".sog"
        studio.fake.send_result("draft", ask["number"] - 1, "magenta")  # of an older request
        studio.fake.send_result("draft", ask["number"], "green", psnr=None)
        studio.wait_for_state("measuring", ask["number"])
        studio.wait_for_colour(GREEN, "right")
        assert studio.share_of_colour(MAGENTA, "right") == 0
        assert "estimated" in studio.page.inner_text("#how")
        assert studio.page.input_value("#psnr") == ""
        studio.fake.send_result("measured", ask["number"], "blue", splats=29, psnr=31.25)
        studio.wait_for_state("measured", ask["number"])
        studio.wait_for_colour(BLUE, "right")
        studio.wait_for_colour(RED, "left")
        assert studio.page.input_value("#psnr") == "31.25"
        assert "got 29" in studio.page.inner_text("#splats-got")
        assert "SSIM 0.9000" in studio.page.inner_text("#result")


def test_a_result_is_shown_before_it_is_measured_and_fetched_once(studio):
    studio.page.get_by_role("button", name="best").click()
    number = studio.fake.wait("ask", 2)["number"]
    studio.fake.send_result("draft", number, "blue")
    studio.fake.send_result("made", number, "green", psnr=30.0)
    studio.wait_for_colour(GREEN, "right")
    studio.wait_for_state("measuring", number)
    assert "estimated" in studio.page.inner_text("#how")
    studio.fake.send_result("measured", number, "green", psnr=32.5)
    studio.wait_for_state("measured", number)
    assert studio.page.input_value("#psnr") == "32.50"
    assert studio.share_of_colour(GREEN, "right") > 0.05
    assert studio.fake.fetched.count("green") == 1


def test_a_result_sent_together_with_its_scores_ends_as_measured(studio):
    studio.page.get_by_role("button", name="best").click()
    number = studio.fake.wait("ask", 2)["number"]
    for kind in ("draft", "made", "measured"):
        studio.fake.send_result(kind, number, "green")
    studio.wait_for_state("measured", number)
    studio.wait_for_colour(GREEN, "right")
    studio.page.wait_for_timeout(200)
    assert studio.page.get_attribute("body", "data-state") == "measured"


def test_a_reload_keeps_the_choice(studio):
    page = studio.page
    page.get_by_role("button", name="best").click()
    page.click("#scene summary")
    page.click("#up [data-value='-z']")
    page.click("#sift summary")
    page.check("#crop")
    page.fill("#x-low", "-0.25")
    page.press("#x-low", "Enter")
    page.click("#take")
    studio.wait_until(lambda: studio.latest_choice()["filters"]["box"])
    chosen = studio.latest_choice()
    assert (chosen["preset"], chosen["up"], chosen["filters"]["box"][0]) == ("best", "-z", -0.25)
    before = len(studio.fake.requests)
    page.reload()
    studio.wait_until(lambda: len(studio.fake.requests) > before)
    assert studio.latest_choice() == chosen
    studio.answer_request()
    assert page.input_value("#x-low") == "-0.25"
    assert page.is_checked("#crop")
    assert page.is_disabled("#undo")
    assert page.get_by_role("button", name="best").get_attribute("aria-pressed") == "true"


def test_a_page_that_is_left_says_so(studio):
    left = studio.fake.wait("ask")["page"]
    studio.page.reload()
    assert studio.fake.wait("ask", 2)["page"] != left
    assert studio.fake.left == [{"page": left}]


def test_the_page_reports_the_models_that_it_has_drawn(studio):
    studio.wait_until(
        lambda: [body["model"] for body in studio.fake.drawn_reports][-1:] == ["blue"]
    )
    assert [body["model"] for body in studio.fake.drawn_reports] in (["blue"], ["original", "blue"])
    # Too few splats to measure it.
    assert all(body["pace"] is None for body in studio.fake.drawn_reports)
    studio.page.get_by_role("button", name="best").click()
    number = studio.fake.wait("ask", 2)["number"]
    studio.fake.send_result("draft", number, "magenta")
    studio.wait_until(lambda: studio.fake.drawn_reports[-1]["model"] == "magenta")
    studio.fake.send_result("made", number, "green")
    studio.wait_until(lambda: studio.fake.drawn_reports[-1]["model"] == "green")
    reported = len(studio.fake.drawn_reports)
    studio.fake.send_result("measured", number, "green")
    studio.wait_for_state("measured", number)
    assert len(studio.fake.drawn_reports) == reported


def test_a_new_model_is_drawn_once_and_the_old_one_no_longer(studio):
    studio.wait_for_colour(BLUE, "right")
    studio.page.evaluate(
        """() => {
          window.drawn = 0;
          const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
          WebGL2RenderingContext.prototype.drawElementsInstanced = function (...all) {
            window.drawn += 1;
            return draw.apply(this, all);
          };
        }"""
    )
    studio.page.get_by_role("button", name="best").click()
    number = studio.fake.wait("ask", 2)["number"]
    studio.fake.send_result("draft", number, "green")
    studio.wait_for_state("measuring", number)
    studio.page.wait_for_selector("#view[data-state=still]", timeout=TIMEOUT)
    studio.page.wait_for_timeout(200)
    assert studio.page.evaluate("window.drawn") == 1
    studio.wait_for_colour(GREEN, "right")


def test_the_three_sliders_move_together(studio):
    page = studio.page
    before = [float(page.input_value(f"#{key}-range")) for key in ("splats", "bytes", "psnr")]
    page.focus("#splats-range")
    page.keyboard.press("PageUp")
    after = [float(page.input_value(f"#{key}-range")) for key in ("splats", "bytes", "psnr")]
    assert all(new > old for new, old in zip(after, before, strict=True))
    assert studio.choice_of_request(2)["wish"]["splats"] > 30
    studio.answer_request(splats=52, bytes=1300, psnr=33.5)
    assert page.input_value("#psnr") == "33.50"
    page.fill("#bytes", "0.0008")
    page.press("#bytes", "Enter")
    assert studio.choice_of_request(3)["wish"] == {"bytes": 800}
    assert 20 < float(page.input_value("#splats")) < 60
    page.fill("#psnr", "36.5")
    page.press("#psnr", "Enter")
    assert studio.choice_of_request(4)["wish"] == {"psnr": 36.5}
    page.get_by_role("button", name="150 splats").click()
    assert studio.choice_of_request(5)["wish"] == {"splats": 150}


def test_drafts_are_shown_while_a_slider_moves(studio):
    studio.page.focus("#splats-range")
    numbers = []
    for count in (2, 3):
        studio.page.keyboard.press("PageUp")
        numbers.append(studio.fake.wait("ask", count)["number"])
    older, newer = numbers
    requested = studio.page.input_value("#splats")
    studio.fake.send_result("draft", older, "green", splats=31)
    studio.wait_for_colour(GREEN, "right")
    assert studio.page.input_value("#splats") == requested
    studio.wait_for_state("coarse", newer)
    studio.fake.send_result("draft", newer, "blue")
    studio.wait_for_state("measuring", newer)
    studio.fake.send_result("draft", older, "magenta")  # too late
    studio.fake.send_result("measured", newer, "blue")
    studio.wait_for_state("measured", newer)
    studio.wait_for_colour(BLUE, "right")


@pytest.mark.parametrize(
    ("typed", "fragment"),
    [
        ("lots", "“lots”"),
        ("5,000", "300"),
        ("5k", "300"),
        ("-1", "“-1”"),
        ("1,5", "“1,5”"),
        ("0.5", "“0.5” is not a whole number"),
        ("40.5", "“40.5” is not a whole number"),
    ],
)
def test_an_invalid_entry_shows_an_error_and_sends_no_request(studio, typed, fragment):
    studio.page.fill("#splats", typed)
    studio.page.press("#splats", "Enter")
    assert fragment in studio.page.get_by_role("alert").inner_text()
    studio.page.wait_for_timeout(100)
    assert len(studio.fake.requests) == 1


def test_numbers_with_a_decimal_comma_or_a_unit_are_refused(studio):
    page = studio.page
    page.click("#sift summary")
    for typed in ("0,5", "0,500", "1.5M", "1,2345", "1.000,5", "e1"):
        for name in ("bytes", "psnr", "opacity"):
            page.fill(f"#{name}", typed)
            page.press(f"#{name}", "Enter")
            assert f"“{typed}”" in page.get_by_role("alert").inner_text()
            page.get_by_role("button", name="Close message").click()
    assert len(studio.fake.requests) == 1


def test_a_valid_entry_clears_the_error_of_the_one_before(studio):
    page = studio.page
    page.click("#sift summary")
    page.check("#crop")
    alert = page.get_by_role("alert")
    for name, wrong, right, reason in (
        ("splats", "0", "100", "is not a number above 0"),
        ("opacity", "50%", "0.5", "is not an opacity"),
        ("x-low", "left", "0.1", "is not a number"),
    ):
        for typed in (wrong, right):
            page.fill(f"#{name}", typed)
            page.press(f"#{name}", "Enter")
            if typed == wrong:
                assert f"“{wrong}” {reason}" in alert.inner_text()
        assert not alert.is_visible()


def test_counts_may_have_decimals_before_a_unit(studio):
    for number, (typed, count) in enumerate([("0.011k", 11), ("0.00024M", 240)], start=2):
        studio.page.fill("#splats", typed)
        studio.page.press("#splats", "Enter")
        assert studio.choice_of_request(number)["wish"] == {"splats": count}


def test_numbers_may_have_commas_between_thousands(studio):
    studio.page.fill("#bytes", "1,234.5")
    studio.page.press("#bytes", "Enter")
    assert studio.choice_of_request(2)["wish"] == {"bytes": 1_234_500_000}


def test_choices_can_be_undone_and_redone(studio):
    page = studio.page
    assert page.is_disabled("#undo")
    page.get_by_role("button", name="best").click()
    assert studio.choice_of_request(2)["preset"] == "best"
    page.select_option("#harmonics", "1")
    assert studio.choice_of_request(3)["sh_degree"] == 1
    page.select_option("#format", ".ply")
    assert studio.choice_of_request(4)["format"] == ".ply"
    page.keyboard.press("Control+z")
    assert studio.choice_of_request(5) == studio.choice_of_request(3)
    page.click("#undo")
    page.click("#undo")
    studio.wait_until(lambda: page.is_disabled("#undo"))
    page.keyboard.press("Control+Shift+Z")
    studio.wait_until(lambda: studio.fake.requests[-1][1]["choice"] == studio.choice_of_request(2))
    assert page.locator("#preset [aria-pressed=true]").inner_text() == "best"


def test_splats_to_be_removed_are_magenta_before_the_filter_is_applied(studio):
    page = studio.page
    page.click("#sift summary")
    page.check("#crop")
    request = studio.fake.wait("filter")
    low, high = studio.fake.scene["bounds"]["low"], studio.fake.scene["bounds"]["high"]
    assert np.allclose(request["choice"]["filters"]["box"], [*low, *high], atol=0.002)
    took = [{"name": "crop", "argument": "", "removed": 100, "left": 200}]
    studio.fake.send_event(
        type="filtered", preview=True, number=request["number"], took=took, left=200,
        model=studio.fake.model("magenta"),
    )  # fmt: skip
    page.wait_for_selector("body[data-preview=shown]", timeout=TIMEOUT)
    studio.wait_for_colour(MAGENTA, "left")
    studio.wait_until(lambda: studio.share_of_colour(AMBER, "right") > 0.001)
    assert "100 splats of 300 removed, 200 left" in page.inner_text("#takes")
    page.click("#untake")
    studio.wait_for_colour(RED, "left")
    assert studio.share_of_colour(AMBER, "right") == 0
    assert len([path for path, _ in studio.fake.requests if path == "ask"]) == 1
    page.fill("#opacity", "0.1")
    page.press("#opacity", "Enter")
    assert studio.fake.wait("filter", 2)["choice"]["filters"]["min_opacity"] == 0.1
    page.click("#take")
    chosen = studio.fake.wait("ask", 2)
    assert chosen["choice"]["filters"] == {"box": None, "min_opacity": 0.1, "floaters": False}
    studio.fake.send_event(
        type="filtered", preview=False, number=chosen["number"], took=took, left=200,
        model=studio.fake.model("green"),
    )  # fmt: skip
    studio.wait_for_colour(GREEN, "left")
    assert page.inner_text("#taken") == "100 removed"
    page.click("#undo")
    assert studio.choice_of_request(3)["filters"]["min_opacity"] is None
    assert page.input_value("#opacity") == "0"


def test_the_left_side_follows_a_scene_that_a_new_worker_has_opened(studio):
    page, fake = studio.page, studio.fake
    took = [{"name": "crop", "argument": "", "removed": 100, "left": 200}]
    filtered = {"type": "filtered", "preview": False, "took": took, "left": 200}
    page.click("#sift summary")
    page.fill("#opacity", "0.1")
    page.press("#opacity", "Enter")
    page.click("#take")
    number = fake.wait("ask", 2)["number"]
    fake.send_event(**filtered, number=number, model=fake.model("green"))
    studio.wait_for_colour(GREEN, "left")
    fake.send_event(**fake.scene)  # the connection was lost, but the worker still runs
    fake.wait("ask", 3)
    assert page.inner_text("#taken") == "100 removed"
    studio.answer_request()
    assert studio.share_of_colour(GREEN, "left") > 0.05
    fake.send_event(**fake.scene | {"model": fake.model("magenta")})
    # The answer to the request for which the worker was started, before it is asked again.
    fake.send_event(**filtered, number=number + 1, model=fake.model("blue"))
    fake.wait("ask", 4)
    studio.wait_for_colour(BLUE, "left")
    assert page.inner_text("#taken") == "100 removed"
    page.click("#undo")
    fake.wait("ask", 5)
    fake.send_event(**fake.scene | {"model": fake.model("green")})
    studio.wait_for_colour(GREEN, "left")
    assert page.inner_text("#taken") == ""


@pytest.mark.parametrize("face", ["x-high", "y-low", "z-high"])
def test_a_face_of_the_crop_box_can_be_dragged_in_the_picture(studio, face):
    page = studio.page
    page.click("#sift summary")
    page.check("#crop")
    low, high = np.split(np.array(studio.fake.wait("filter")["choice"]["filters"]["box"]), 2)
    studio.pixels()  # wait until nothing moves

    def centre(name):
        box = page.locator(f".nv-handle[data-face={name}]").bounding_box()
        return np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])

    other = face.replace("high", "low") if "high" in face else face.replace("low", "high")
    start, end = centre(face), centre(other)
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*(start + 0.3 * (end - start)), steps=3)
    page.mouse.up()

    def last_box():
        return [
            body["choice"]["filters"]["box"]
            for each, body in studio.fake.requests
            if each == "filter"
        ][-1]

    axis, is_high = "xyz".index(face[0]), face.endswith("high")
    moved_end = axis + 3 * is_high
    assert float(page.input_value(f"#{face}")) != [*low, *high][moved_end]
    # The page waits for a pause in the movement before it asks for what its fields show.
    studio.wait_until(lambda: last_box()[moved_end] == float(page.input_value(f"#{face}")))
    moved = np.array(last_box()).reshape(2, 3)
    share = (moved[int(is_high), axis] - (high if is_high else low)[axis]) / (high - low)[axis]
    assert 0.15 < (-share if is_high else share) < 0.45
    moved[int(is_high), axis] = (high if is_high else low)[axis]
    assert np.array_equal(moved, [low, high])  # no other face moved
    assert np.abs(centre(face) - (start + 0.3 * (end - start))).max() < 30
    # At once, not with the next frame: until then, a handle of the removed box could be dragged.
    hidden = "[...document.querySelectorAll('.nv-handle')].every((dot) => dot.hidden)"
    assert page.evaluate(f"() => {{ document.getElementById('untake').click(); return {hidden}; }}")


def test_the_error_map_is_bright_where_the_sides_differ(studio):
    page = studio.page
    first = studio.pixels()
    page.keyboard.press("e")
    studio.wait_until(lambda: studio.share_of_colour(BLUE, "right") == 0)
    pixels = studio.pixels()
    half = pixels.shape[1] // 2
    assert np.array_equal(pixels[:, :half], first[:, :half])
    # Red and blue differ by 0.14 in luma, which is at 0.75 of the colour map.
    assert studio.share_of_colour((249 / 255, 140 / 255, 10 / 255), "right") > 0.05
    assert page.is_visible("#legend")
    page.fill("#splats", "300")
    page.press("#splats", "Enter")
    studio.fake.wait("ask", 2)
    studio.answer_request("original", splats=300)
    studio.wait_until(lambda: studio.pixels()[:, half + 30 :].max() < 0.03)  # nothing differs
    page.click("#heat")
    studio.wait_for_colour(RED, "right")
    assert not page.is_visible("#legend")


def test_opening_the_filters_leaves_what_is_typed_into_them(studio):
    page = studio.page
    page.click("#sift summary")
    page.fill("#opacity", "0.1")
    # Browsers send this event late: a quick user has typed by then.
    page.evaluate("document.getElementById('sift').dispatchEvent(new Event('toggle'))")
    assert page.input_value("#opacity") == "0.1"


def test_the_legend_of_the_error_map_holds_its_numbers_and_tells_of_magenta(studio):
    """Splats to be removed differ from the result by their magenta, not by an error of it."""
    page, fake = studio.page, studio.fake
    page.keyboard.press("e")
    legend = page.locator("#legend").bounding_box()
    for mark in (box.bounding_box() for box in page.locator("#legend-marks span").all()):
        assert legend["x"] + 4 < mark["x"]
        assert mark["x"] + mark["width"] < legend["x"] + legend["width"] - 4
    assert not page.is_visible("#legend-preview")
    page.click("#sift summary")
    page.check("#crop")
    number = fake.wait("filter")["number"]
    took = [{"name": "crop", "argument": "", "removed": 100, "left": 200}]
    fake.send_event(
        type="filtered", preview=True, number=number, took=took, left=200,
        model=fake.model("magenta"),
    )  # fmt: skip
    page.wait_for_selector("#legend-preview:visible", timeout=TIMEOUT)
    page.click("#untake")
    studio.wait_until(lambda: not page.is_visible("#legend-preview"))


def test_a_reduced_model_is_said_to_be_one_beside_the_picture_and_the_error_map(studio):
    page, fake = studio.page, studio.fake
    page.keyboard.press("e")
    assert not page.is_visible("#legend-note")
    page.click("#sift summary")
    page.fill("#opacity", "0.1")
    page.press("#opacity", "Enter")
    page.click("#take")
    number = fake.wait("ask", 2)["number"]
    took = [{"name": "opacity", "argument": "", "removed": 100, "left": 200}]
    model = fake.model("green", 50) | {"of": 200, "note": "50 are drawn in place of 200."}
    fake.send_event(
        type="filtered", preview=False, number=number, took=took, left=200, model=model
    )  # fmt: skip
    page.wait_for_selector("#legend-note:visible", timeout=TIMEOUT)
    label = page.locator(".nv-label.nv-left").inner_text()
    assert "200 splats of 300" in label
    assert "50 are drawn in place of 200." in label
    page.click("#undo")
    number = fake.wait("ask", 3)["number"]
    fake.send_event(
        type="filtered", preview=False, number=number, took=[], left=300, model=fake.model("blue")
    )  # fmt: skip
    studio.wait_until(lambda: not page.is_visible("#legend-note"))


def test_another_up_turns_the_picture_and_the_old_one_restores_it(studio):
    page = studio.page
    first = studio.pixels()
    page.click("#scene summary")
    page.get_by_role("button", name="+x", exact=True).click()
    assert studio.choice_of_request(2)["up"] == "+x"
    studio.wait_until(lambda: (np.abs(studio.pixels() - first).max(axis=-1) > 0.3).mean() > 0.01)
    turned = studio.pixels()
    page.locator("#view canvas").focus()
    page.keyboard.press("ArrowRight")
    page.click("#first-view")
    studio.wait_until(lambda: np.array_equal(studio.pixels(), turned))
    page.click("#up [data-value='-y']")
    assert studio.choice_of_request(3)["up"] == "-y"
    studio.wait_until(lambda: np.array_equal(studio.pixels(), first))


def test_a_new_model_keeps_the_camera(studio):
    page = studio.page
    first = studio.pixels()
    page.locator("#view canvas").focus()
    page.keyboard.press("ArrowRight")
    studio.wait_until(lambda: not np.array_equal(studio.pixels(), first))
    turned = studio.pixels()
    page.fill("#splats", "40")
    page.press("#splats", "Enter")
    studio.fake.wait("ask", 2)
    studio.answer_request("green")
    studio.wait_for_colour(GREEN, "right")
    half = turned.shape[1] // 2
    assert np.array_equal(studio.pixels()[:, :half], turned[:, :half])


def test_a_short_name_of_a_scene_is_replaced_once_in_that_of_its_levels(tab):
    with opened(tab) as studio:
        studio.fake.scene |= {"stem": "s", "name": "s.ply"}
        studio.fake.scene["layouts"] = [{**LAYOUT, "example": "s/tileset.json"}]
        studio.page.reload()
        studio.fake.wait("ask", 2)
        studio.answer_request()
        studio.page.keyboard.press("Control+s")
        studio.page.wait_for_selector("#entries >> text=old/")
        studio.page.select_option("#save-format", "levels tileset.json")
        assert studio.page.input_value("#save-name") == "s-small/tileset.json"


def test_a_format_that_is_a_folder_is_saved_as_a_folder_of_the_chosen_name(tab):
    with opened(tab) as studio:
        studio.fake.scene["formats"] = [".sog", "meta.json"]
        studio.page.reload()
        studio.fake.wait("ask", 2)
        studio.answer_request()
        page = studio.page
        page.keyboard.press("Control+s")
        page.wait_for_selector("#entries >> text=old/")
        page.select_option("#save-format", "file meta.json")
        assert page.input_value("#save-name") == "scene-small/meta.json"
        page.fill("#save-name", "x/meta.json")
        page.select_option("#save-format", "file .sog")
        assert page.input_value("#save-name") == "x.sog"


def test_a_cancelled_request_is_still_called_so_after_a_save(studio):
    page, fake = studio.page, studio.fake
    page.get_by_role("button", name="best").click()
    number = fake.wait("ask", 2)["number"]
    fake.send_event(type="cancelled", number=number, kind="ask")
    studio.wait_until(lambda: page.inner_text("#said") == "Cancelled")
    page.keyboard.press("Control+s")
    page.wait_for_selector("#entries >> text=old/")
    page.fill("#save-name", "new.sog")
    page.click("#save-go")
    request = fake.wait("save")
    fake.send_event(
        type="saved", number=request["number"], path="new.sog", bytes=5000, report={},
        command="nanogs it", short=None, replaced=False, lines=[],
    )  # fmt: skip
    studio.wait_until(lambda: "5.0 kB" in page.inner_text("#save-said"))
    assert page.inner_text("#said") == "Cancelled"


def test_saving_asks_before_it_replaces_a_file_and_shows_the_command(studio):
    page, fake = studio.page, studio.fake
    page.keyboard.press("Control+s")
    page.wait_for_selector("#entries >> text=old/")
    assert page.input_value("#save-name") == "scene-small.sog"
    studio.wait_until(lambda: "scene-small.sog" in page.inner_text("#save-command"))
    page.press("#save-name", "Enter")
    assert "exists" in page.inner_text("#save-said")
    assert not [path for path, _ in fake.requests if path == "save"]
    page.click("#save-go")
    request = fake.wait("save")
    assert request["path"] == "scene-small.sog"
    assert request["overwrite"] is True
    assert request["choice"]["levels"] is None
    studio.wait_for_state("saving")
    fake.send_event(
        type="progress", number=request["number"], kind="save", stage="fit", fraction=0.5
    )
    studio.wait_until(lambda: "fit" in page.inner_text("#save-said"))
    page.click("#save-cancel")
    fake.wait("cancel")
    fake.send_event(type="cancelled", number=request["number"], kind="save")
    studio.wait_for_state("measured")
    page.select_option("#save-format", "levels tileset.json")
    assert page.input_value("#save-name") == "scene-small/tileset.json"
    page.fill("#ratios", "1,0.2")
    page.evaluate(
        """() => { const get = window.fetch; window.fetch = (...given) =>
          new Promise((then) => setTimeout(() => then(get(...given)), 300)); }"""
    )
    page.click("#entries >> text=old/")
    page.click("#save-go")  # before the folder is listed
    request = fake.wait("save", 2)
    assert request["path"] == "old/scene-small/tileset.json"
    assert request["choice"]["levels"] == "1,0.2"
    assert request["overwrite"] is False
    fake.send_event(
        type="saved", number=request["number"], path=request["path"], bytes=5000, report={},
        command="nanogs lod it", short=None, replaced=False, lines=[["Splats", "30 of 300"]],
    )  # fmt: skip
    studio.wait_until(lambda: "5.0 kB" in page.inner_text("#save-said"))
    assert page.inner_text("#save-command") == "nanogs lod it"
    assert "30 of 300" in page.inner_text("#save-lines")
    studio.wait_for_state("measured")


def test_a_browser_without_webgl_gets_a_message(chromium):
    with running_fake(MODELS) as (_, address):
        page = chromium.new_page()
        page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
        page.goto(address)
        page.wait_for_selector("body[data-state=failed]", timeout=TIMEOUT)
        text = page.get_by_role("alert").inner_text()
        assert text == "The studio cannot draw: this browser has no WebGL 2, or it is switched off."
        assert page.inner_text("#said") == ""
        enabled = page.locator("button:enabled:visible, input:enabled:visible, select:enabled")
        assert enabled.evaluate_all("all => all.map((it) => it.ariaLabel)") == ["Close message"]
        page.get_by_role("button", name="Close message").click()
        assert not page.is_visible("#alert")
        page.close()


def test_a_scene_that_cannot_be_opened_gets_its_message_and_may_open_later(tab):
    with running_fake(MODELS) as (fake, address), without_errors(tab):
        message = "The model shows nothing."
        scene, fake.scene = fake.scene, {
            "type": "failed", "number": None, "kind": "open", "message": message,
        }  # fmt: skip
        tab.goto(address)
        tab.wait_for_selector("body[data-state=failed]", timeout=TIMEOUT)
        assert tab.get_by_role("alert").inner_text() == message
        assert tab.inner_text("#said") == ""
        fake.send_event(**scene)
        fake.wait("ask")
        assert not tab.is_visible("#alert")
        tab.evaluate("sessionStorage.clear()")
        tab.goto("about:blank")


def test_a_plot_of_one_point_has_its_size_on_the_axis(tab):
    with opened(tab, answered=False) as studio:
        studio.answer_request(bytes=1_300_000)
        page = studio.page
        page.wait_for_selector("#plot .present", timeout=TIMEOUT)
        assert "1.3 MB" in page.locator("#plot text").all_text_contents()


def test_a_failure_is_shown_as_a_message(studio):
    page, fake = studio.page, studio.fake
    page.click("#format")
    page.select_option("#format", ".ply")
    number = fake.wait("ask", 2)["number"]
    fake.send_event(type="failed", number=number - 1, kind="measure", message="Long ago.")
    fake.send_event(
        type="failed", number=number, kind="measure", message="There is no memory left."
    )
    studio.wait_for_state("failed", number)
    assert page.get_by_role("alert").inner_text() == "There is no memory left."
    page.get_by_role("button", name="Close message").click()
    assert not page.is_visible("#alert")


def test_work_is_cancelled_by_a_button_and_by_a_key(studio):
    page, fake = studio.page, studio.fake
    page.select_option("#format", ".ply")
    number = fake.wait("ask", 2)["number"]
    for count, stop in enumerate(
        (page.locator("#cancel").click, lambda: page.keyboard.press("Escape")), 1
    ):
        fake.send_event(
            type="progress", number=number, kind="measure", stage="views", fraction=0.25
        )
        page.wait_for_selector("#cancel:visible")
        assert float(page.get_attribute("#progress", "value")) == 0.25
        page.locator("#first-view").focus()
        stop()
        fake.wait("cancel", count)
    fake.send_event(type="cancelled", number=number, kind="measure")
    studio.wait_for_state("coarse", number)
    studio.wait_until(lambda: not page.is_visible("#cancel"))
    assert page.inner_text("#said") == "Cancelled"


def test_the_status_line_says_stages_in_words(studio):
    """It said "Saving: correct_1"; a stage without words leaves the job alone."""
    page, fake = studio.page, studio.fake
    number = fake.requests[-1][1]["number"]
    for stage, words in [
        ("correct_1", "Making the model: choosing what to merge"),
        ("level_0", "Making the model: level 0"), ("sift", "Making the model …"),
    ]:  # fmt: skip
        fake.send_event(type="progress", number=number, kind="draft", stage=stage, fraction=0.5)
        studio.wait_until(lambda words=words: page.inner_text("#said") == words)


def test_the_status_line_is_at_rest_once_the_plot_is_filled(studio):
    """It said "Filling the plot" for as long as nothing else was asked for."""
    page, fake = studio.page, studio.fake
    fake.send_event(type="progress", number=None, kind="curve", stage="measure", fraction=0.9)
    page.wait_for_selector("#progress:visible")
    fake.send_event(type="explored")
    studio.wait_until(lambda: page.inner_text("#said") == "Ready")
    assert not page.is_visible("#progress")


def test_each_stage_of_a_result_has_words(studio):
    package = Path(nanogs.__file__).parent
    code = [*package.glob("pipeline/**/*.py"), package / "levels_of_detail.py"]
    named = {
        name
        for path in code
        for name in re.findall(r"(?:\bStage|\.begin)\(\"(\w+)\"", path.read_text(encoding="utf-8"))
    }
    assert {"search", "pack", "measure"} < named
    said = studio.page.evaluate(
        "async names => { const { jobText } = await import('./static/stages.js');"
        " return names.map((name) => jobText('Saving', name)); }",
        sorted(stages := named | set(STAGES)),
    )
    without = [name for name, words in zip(sorted(stages), said, strict=True) if "…" in words]
    assert without == []


@pytest.mark.parametrize("focused", ["#splats-range", "#splats", "#format", "#floaters"])
def test_escape_cancels_whatever_has_the_focus(studio, focused):
    page, fake = studio.page, studio.fake
    page.click("#sift summary")
    page.select_option("#format", ".ply")
    number = fake.wait("ask", 2)["number"]
    fake.send_event(type="progress", number=number, kind="measure", stage="views", fraction=0.25)
    page.wait_for_selector("#cancel:visible")
    page.focus(focused)
    page.keyboard.press("Escape")
    fake.wait("cancel", 1)


def test_shortcuts_work_beside_the_keys_of_the_focused_control(studio):
    page = studio.page
    shown = page.locator("#heat[aria-pressed=true]")
    first = studio.pixels()
    page.click("#sift summary")
    page.focus("#splats-range")
    before = float(page.input_value("#splats-range"))
    page.keyboard.press("ArrowRight")
    assert float(page.input_value("#splats-range")) == before + 1
    assert np.array_equal(studio.pixels(), first)  # the camera stays
    page.keyboard.press("e")
    assert shown.count() == 1
    page.focus("#floaters")
    page.keyboard.press(" ")
    assert page.is_checked("#floaters")
    page.keyboard.press("e")
    assert shown.count() == 0
    page.focus("#splats")
    page.keyboard.press("e")
    assert shown.count() == 0


@pytest.mark.parametrize(
    ("width", "height", "scheme"),
    [(1280, 800, "dark"), (390, 844, "light"), (844, 390, "dark")],
)
def test_the_page_fits_any_screen_and_every_control_has_a_label(chromium, width, height, scheme):
    context = chromium.new_context(color_scheme=scheme, has_touch=width < 1000)
    with opened(context.new_page(), width, height) as studio:
        page = studio.page
        for details in ("#sift", "#scene"):
            page.click(f"{details} summary")
        page.check("#crop")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.eval_on_selector("#panel", "it => it.scrollWidth <= it.clientWidth")
        picture = page.locator("#picture").bounding_box()
        assert picture["width"] * picture["height"] > 0.3 * width * height
        nameless = page.evaluate(
            """[...document.querySelectorAll("input, select, button")].filter((it) =>
                !it.labels?.length && !it.ariaLabel && !it.textContent.trim()).map((it) => it.id)"""
        )
        assert nameless == []
        if folder := os.environ.get("NANOGS_SCREENSHOTS"):
            page.screenshot(path=f"{folder}/studio_{width}_{scheme}.png")
    context.close()


@pytest.mark.parametrize(("width", "height"), [(360, 640), (640, 360)])
def test_dialogues_fit_a_phone_and_the_help_begins_at_its_title(tab, width, height):
    with opened(tab, width, height) as studio:
        page = studio.page
        for name in ("help", "save"):
            page.click(f"#{name}-open")
            box = page.locator(f"#{name}").bounding_box()
            assert box["y"] >= 0
            assert box["y"] + box["height"] <= height
            title = page.locator(f"#{name}-title").bounding_box()
            assert 0 <= title["y"] - box["y"] < 30
            page.keyboard.press("Escape")


def test_only_the_panel_scrolls(tab):
    """Hidden text that was laid out below the window let find and screen readers scroll it."""
    with opened(tab, 360, 640) as studio:
        page = studio.page
        page.click("#sift summary")
        page.check("#crop")
        assert page.evaluate("document.scrollingElement.scrollHeight") == 640
        page.evaluate("document.querySelector('#box legend').scrollIntoView()")
        assert page.evaluate("document.scrollingElement.scrollTop") == 0


def test_an_option_of_the_command_is_never_broken(studio):
    page = studio.page
    page.click("#save-open")
    studio.wait_until(lambda: page.text_content("#save-command"))  # it is not replaced below
    lines = """code => {
        const options = [...code.querySelectorAll("span")];
        return options.map((option) => option.getClientRects().length);
    }"""
    for letters in range(2, 40):
        command = f"nanogs simplify scene.ply {'x' * letters} --sh-degree 1 --count 10 -w"
        page.evaluate(
            "async command => (await import('./static/dom.js'))"
            ".showCommand(document.getElementById('save-command'), command)",
            command,
        )
        assert page.text_content("#save-command") == command
        assert page.locator("#save-command").evaluate(lines) == [1, 1, 1]


def test_without_javascript_only_the_message_is_shown(chromium):
    context = chromium.new_context(java_script_enabled=False)
    page = context.new_page()
    with running_fake(MODELS) as (_, address):
        page.goto(address)
        assert "JavaScript" in page.inner_text("#view")
        for name in ("panel", "status", "save-open", "first-view"):
            assert not page.locator(f"#{name}").is_visible()
    context.close()
