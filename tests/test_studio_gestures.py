"""Random gestures on the page of `nanogs studio`, in any order: no error, and no lost job."""

import re

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import nanogs
import studio_page
from browsers import CHROMIUM, browser
from builders import random_splats
from studio import running
from studio_page import StudioPage
from viewer_bundle import require_bundle

pytestmark = [
    pytest.mark.story,
    pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed"),
    pytest.mark.filterwarnings("default"),  # the driver's own warnings are not ours
]
SPLATS = 300
SEQUENCES, LENGTH = 10, 20
# Browsers log these statuses as errors; the page shows a message for each.
REFUSED = ("409", "422")
names = st.sampled_from(["splats", "bytes", "psnr"])
positions = st.integers(0, 1000)
entries = st.sampled_from(["100", "50k", "0", "-3", "no number", "0.004", "1e9", "30", "", "40.5"])
faces = st.sampled_from([f"{axis}-{end}" for axis in "xyz" for end in ("low", "high")])
offsets = st.integers(-80, 80)  # CSS pixels
sizes = st.sampled_from([(1280, 800), (390, 844), (700, 500)])
# Whether a click on "Save" has its answer. Until the name is checked, the button is disabled and
# nothing is said; while the file is written, there is a button to cancel.
ANSWERED = """() => document.getElementById('save-cancel').hidden
  && (!document.getElementById('save-go').disabled
      || document.getElementById('save-said').matches('.wrong:not(:empty)'))"""
gestures = st.one_of(
    st.tuples(st.just("slide"), names, positions),
    st.tuples(st.just("slide"), names, positions),
    st.tuples(st.just("type"), names, entries),
    st.tuples(st.just("click"), st.sampled_from(["undo", "redo", "heat", "first-view"])),
    st.tuples(
        st.just("key"), st.sampled_from(["Control+z", "Control+Shift+z", "e", "0", "Escape"])
    ),
    st.tuples(st.just("press"), st.just("preset"), st.sampled_from(["fast", "default"])),
    st.tuples(st.just("press"), st.just("mode"), st.sampled_from(["default", "mip"])),
    st.tuples(st.just("press"), st.just("up"), st.sampled_from(["+z", "-y"])),
    st.tuples(st.just("format"), st.sampled_from([".sog", ".spz", ".ply"])),
    st.tuples(st.just("harmonics"), st.sampled_from(["", "0"])),
    st.tuples(st.just("opacity"), positions),
    st.tuples(st.just("check"), st.sampled_from(["floaters", "crop"]), st.booleans()),
    st.tuples(
        st.just("corner"), st.sampled_from("xyz"), st.sampled_from(["low", "high"]), positions
    ),
    st.tuples(st.just("drag"), faces, offsets, offsets),
    st.tuples(st.just("click"), st.sampled_from(["take", "untake"])),
    st.tuples(
        st.just("save"), st.sampled_from(["a.sog", "b.spz", "sub/c.ply", "no", "../out.ply"])
    ),
    st.tuples(st.just("cancel")),
    st.tuples(st.just("resize"), sizes),
    st.tuples(st.just("reload")),
)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A page of a studio with a tiny scene."""
    require_bundle()
    folder = tmp_path_factory.mktemp("gestures")
    (folder / "sub").mkdir()
    nanogs.save(random_splats(SPLATS, degree=1), folder / "scene.ply")
    with (
        browser() as chromium,
        running("scene.ply", "--preset", "fast", "--idle", "0", cwd=folder) as studio,
    ):
        page = StudioPage(chromium, studio.url, 700, 500)
        page.expected = REFUSED
        yield page
        page.close()
        assert not [each for each in folder.rglob("*") if each.name.startswith(".nanogs")]


class Hand:
    """Performs gestures as soon as the page allows it, without waiting for answers."""

    def __init__(self, seen):
        self.seen = seen

    def slide(self, name, position):
        self.seen.slide(name, position)

    def type(self, name, words):
        self.seen.type(name, words)

    def click(self, name):
        """Check and click in one step, because an answer may hide the button in between."""
        self.seen.at(name).evaluate("(button) => button.checkVisibility() && button.click()")

    def key(self, keys):
        self.seen.page.locator("body").press(keys)

    def press(self, name, value):
        self.seen.at(name).locator(f"[data-value='{value}']").click()

    def format(self, suffix):
        self.seen.at("format").select_option(suffix)

    def harmonics(self, degree):
        self.seen.at("harmonics").select_option(degree)

    def opacity(self, position):
        self.seen.at("opacity-range").fill(str(position))

    def check(self, name, on):
        self.seen.at(name).set_checked(on)

    def corner(self, axis, end, position):
        if self.seen.at("crop").is_checked():
            self.seen.at(f"{axis}-{end}-range").fill(str(position))

    def drag(self, face, right, down):
        handle = self.seen.page.locator(f".nv-handle[data-face={face}]")
        if handle.is_visible() and (box := handle.bounding_box()):
            x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
            self.seen.page.mouse.move(x, y)
            self.seen.page.mouse.down()
            self.seen.page.mouse.move(x + right, y + down, steps=3)
            self.seen.page.mouse.up()

    def cancel(self):
        self.click("cancel")

    def resize(self, size):
        self.seen.page.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))

    def reload(self):
        self.seen.page.reload()
        self.seen.until("() => document.body.dataset.number")
        for name in ("sift", "scene"):
            self.seen.unfold(name)

    def save(self, name):
        """Save, wait until that has succeeded or failed, and then close the dialogue."""
        seen = self.seen
        seen.at("save-open").click()
        suffix = re.search(r"\.\w+$", name)
        if suffix:
            seen.at("save-format").select_option(f"file {suffix[0]}")
        seen.at("save-name").fill(name)
        seen.until(ANSWERED)  # a name refused before disables the button
        for _ in range(2):  # the second click confirms that a file is replaced
            self.click("save-go")  # the check of the name may still refuse it
            seen.until(ANSWERED)
        assert seen.text("save-said")
        seen.at("save-close").click()


def assert_settled(seen):
    """Check that the latest request has ended and says so, and that nothing else failed."""
    seen.until(f"() => ({studio_page.SETTLED})() || document.getElementById('said')"
               ".textContent === 'Cancelled'")  # fmt: skip
    seen.still()
    if seen.state == "failed":
        assert seen.alert.endswith(".")
    assert seen.unexpected == [], seen.unexpected


def test_random_gestures_cause_no_error_and_lose_no_job(seen):
    # One example is many gestures; failures are shown whole, without shrinking.
    @settings(max_examples=SEQUENCES, phases=[Phase.generate], suppress_health_check=HealthCheck)
    @given(st.lists(gestures, min_size=LENGTH, max_size=LENGTH))
    def do(sequence):
        hand = Hand(seen)
        hand.reload()
        for name, *arguments in sequence:
            getattr(hand, name)(*arguments)
        assert_settled(seen)
        if (box := seen.at("untake")).is_enabled():
            box.click()
        hand.slide("splats", 700 if seen.at("splats-range").input_value() != "700" else 600)
        assert_settled(seen)

    do()
