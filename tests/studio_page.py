"""The page of `nanogs studio` in a browser: a user's actions, and waiting for their results."""

TIMEOUT = 60_000  # timeout, milliseconds; test machines are busy
SETTLED = "() => ['measured', 'failed'].includes(document.body.dataset.state)"
NUMBER = "Number(document.body.dataset.number || 0)"


class StudioPage:
    """An open page, with the errors on its console."""

    def __init__(self, chromium, url, width=1280, height=800, **options):
        size = {"width": width, "height": height}
        self.context = chromium.new_context(viewport=size, **options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(TIMEOUT)
        self.errors, self.foreign = [], []
        self.expected = ()  # words of errors that a test causes on purpose
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", self._log_error)
        self.page.on("request", lambda request: self._note_request(request.url, url))
        self.page.goto(url)

    def _log_error(self, message):
        if message.type == "error":
            self.errors.append(f"{message.text} {message.location.get('url', '')}")

    def _note_request(self, address, studio_url):
        if not address.startswith((studio_url, "data:", "blob:")):
            self.foreign.append(address)

    def close(self):
        """Close the page, and check that it had no errors and requested nothing from elsewhere."""
        self.context.close()
        assert self.unexpected == [], self.unexpected
        assert self.foreign == [], self.foreign

    @property
    def unexpected(self):
        """Errors on the console except for those that a test causes on purpose."""
        return [text for text in self.errors if not any(word in text for word in self.expected)]

    def at(self, name):
        """Return a locator of the element with an ID."""
        return self.page.locator(f"#{name}")

    def text(self, name):
        """Return the text of an element."""
        return self.at(name).text_content().strip()

    def value(self, name):
        """Return the content of a field as a number."""
        return float(self.at(name).input_value().replace(",", "") or "nan")

    @property
    def state(self):
        """The state of the page, such as "measured"."""
        return self.page.evaluate("document.body.dataset.state")

    @property
    def number(self):
        """The number of the page's latest request."""
        return self.page.evaluate(NUMBER)

    @property
    def alert(self):
        """The error message that is shown, or an empty string."""
        alert = self.at("alert")
        return alert.locator("p").text_content() if alert.is_visible() else ""

    def until(self, condition, argument=None):
        """Wait until a JavaScript expression or function is true."""
        from playwright.sync_api import TimeoutError as PlaywrightTimeout

        try:
            self.page.wait_for_function(condition, arg=argument, timeout=TIMEOUT)
        except PlaywrightTimeout:
            texts = {name: self.text(name) for name in ("said", "save-said", "takes", "command")}
            data = self.page.evaluate("({...document.body.dataset})")
            raise AssertionError((condition, data, texts, self.alert, self.errors)) from None

    def settle(self, after=0):
        """Wait until a request later than `after` is measured, and its picture stands still."""
        self.until(f"after => {NUMBER} > after && ({SETTLED})()", after)
        self.still()

    def still(self):
        """Wait until the picture stands still."""
        self.page.wait_for_selector("#view[data-state=still]", timeout=TIMEOUT)

    def measured(self, action):
        """Call a function that changes the choice, and wait until the result is measured."""
        before = self.number
        action()
        self.settle(before)
        assert self.state == "measured", self.alert

    def slide(self, name, position):
        """Move a slider, from 0 to 1000."""
        self.at(f"{name}-range").fill(str(position))

    def type(self, name, words):
        """Type into a field, and press Enter."""
        self.at(name).fill(str(words))
        self.at(name).press("Enter")

    def unfold(self, name):
        """Unfold a `details` element if it is folded."""
        if not self.at(name).evaluate("element => element.open"):
            self.at(name).locator("summary").click()
