"""Time `nanogs studio` in a browser, from a slider's input to the coarse and the measured answer.

    python benchmarks/studio.py [MODEL ...] [--counts 1000000] [--ratios 0.5,0.2,0.1,0.05]
                                [--preset default] [--rounds 1] [--json FILE]

Without a model: biker.spz of the real scenes (NANOGS_SCENES), and synthetic scenes of --counts
splats. The time starts at the slider's `input` event in the page, and ends when the view is still
and a pixel of the answer's image was read back, which waits until it is drawn. Further columns:
until the event of the answer arrived, until its model was downloaded, and until that was decoded;
the rest is drawing. The result's image is shown before its scores, which are measured afterwards.
Without a graphics card, the processor draws (SwiftShader), and competes with the computation.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import nanogs
from nanogs.datasets.synthetic import make_scene
from rivals import REAL_SCENES, ROOT

TIMEOUT = 600_000  # milliseconds
COLUMNS = {
    "draft": "told", "model": "model there", "decoded": "decoded", "coarse": "coarse picture",
    "made": "result's picture", "measured": "measured",
}  # fmt: skip
# Inserted into the page before its own scripts: records the time of each event and download.
WATCH = """
(() => {
  const seen = (window.seen = {});
  const limits = (window.limits = {});
  const note = (name) => { seen[name] ??= (performance.now() - seen.begun) / 1000; };
  const Source = window.EventSource;
  window.EventSource = class extends Source {
    constructor(...all) {
      super(...all);
      this.addEventListener("message", ({ data }) => {
        const { type, number, splats, available, fewest } = JSON.parse(data);
        if (type === "scene") limits.splats = splats;
        if (available) Object.assign(limits, { available, fewest });
        if (["draft", "measured"].includes(type) && number === Number(document.body.dataset.number))
          note(type === "draft" ? "draft" : "answer");
      });
    }
  };
  const fetched = window.fetch;
  window.fetch = async (...all) => {
    const found = await fetched(...all);
    if (String(all[0]).startsWith("models/")) note(seen.answer ? "last" : "model");
    return found;
  };
  // Drawing goes on behind the page; reading a pixel waits for its end.
  const drawn = (name) => {
    if (seen[name]) return;
    const gl = document.querySelector("#view canvas").getContext("webgl2");
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    note(name);
  };
  const look = () => {
    const still = document.getElementById("view")?.dataset.state === "still";
    const state = document.body?.dataset.state;
    const shown = seen.draft && ["measuring", "measured"].includes(state);
    if (shown) note("decoded");
    if (shown && still) drawn("coarse");
    if (shown && still && document.body.dataset.seen !== "draft") drawn("made");
    if (shown && still && state === "measured") drawn("measured");
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})();
"""
# Simulates a drag of the slider to a ratio: an `input` event and a `change` event.
SLIDE = """(ratio) => {
  const { available, splats } = limits;
  const fewest = Math.max(limits.fewest, Math.min(100, available / 1000)); // as sliders.js has it
  for (const name of Object.keys(seen)) delete seen[name];
  const range = document.getElementById("splats-range");
  const place = Math.log((ratio * splats) / fewest) / Math.log(available / fewest);
  range.value = Math.round(range.max * place);
  seen.begun = performance.now();
  range.dispatchEvent(new Event("input", { bubbles: true }));
  range.dispatchEvent(new Event("change", { bubbles: true }));
}"""
MEASURED = "(before) => Number(document.body.dataset.number) > before && !!seen.measured"
RENDERER = """() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  const told = gl && gl.getExtension("WEBGL_debug_renderer_info");
  return told ? gl.getParameter(told.UNMASKED_RENDERER_WEBGL) : "unknown";
}"""


def main() -> None:
    """Print a table with a row for each model and ratio, medians, and the studio's memory."""
    options = _options()
    sys.path.insert(0, str(ROOT / "tests"))
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for model in _models(options, Path(folder)):
            found += _measure(model, Path(folder), options)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))
    _show(found)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--counts", default="1000000", help="of made-up scenes, commas between")
    parser.add_argument("--ratios", default="0.5,0.2,0.1,0.05", help="with commas between")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write all that was found")
    return parser.parse_args()


def _models(options: argparse.Namespace, folder: Path) -> Iterator[Path]:
    if options.models:
        yield from options.models
        return
    scene = REAL_SCENES / "biker.spz"
    if scene.exists():
        yield scene
    for count in map(int, filter(None, options.counts.split(","))):
        nanogs.save(make_scene(count), path := folder / f"made_up_{count}.ply")
        yield path


def _measure(model: Path, folder: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure the seconds of each slider move, with the name of the WebGL renderer."""
    found = []
    with _opened(model, folder, options.preset) as (page, studio):
        renderer = page.evaluate(RENDERER)
        _settle(page)
        splats = page.evaluate("limits.splats")
        ratios = [float(ratio) for ratio in options.ratios.split(",")]
        for turn in range(options.rounds):
            for ratio in ratios:
                before = page.evaluate("Number(document.body.dataset.number)")
                page.evaluate(SLIDE, ratio)
                page.wait_for_function(MEASURED, arg=before, timeout=TIMEOUT)
                got = {"model": model.name, "splats": splats, "ratio": ratio, "round": turn}
                seconds = page.evaluate("seen")
                del seconds["begun"]
                found.append(got | {"renderer": renderer, "seconds": seconds})
                print(json.dumps(found[-1]), file=sys.stderr, flush=True)
        for each in found:
            each["memory"] = _peak(studio.process.pid)
    return found


def _peak(pid: int) -> int:
    """Sum the peak resident bytes of a process and its children, each at its own peak; Linux."""
    import psutil

    root = psutil.Process(pid)
    total = 0
    for process in (root, *root.children(recursive=True)):
        status = Path(f"/proc/{process.pid}/status")
        words = status.read_text().partition("VmHWM:")[2] if status.exists() else ""
        total += int(words.split()[0]) << 10 if words else 0
    return total


@contextmanager
def _opened(model: Path, folder: Path, preset: str) -> Iterator[Any]:
    """Start a studio and open its page with `WATCH` inserted; yield both."""
    from browsers import browser
    from studio import running  # type: ignore[attr-defined]  # the one of the tests

    with (
        browser() as chromium,
        running(model.resolve(), "--preset", preset, cwd=folder) as studio,
    ):
        page = chromium.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(WATCH)
        page.goto(studio.url)
        yield page, studio


def _settle(page: Any) -> None:  # noqa: ANN401 - a page of Playwright
    """Wait until the page's first result is measured."""
    page.wait_for_function("() => document.body.dataset.state === 'measured'", timeout=TIMEOUT)


def _show(found: list[dict[str, Any]]) -> None:
    drawn = {each["renderer"] for each in found}
    print(f"WebGL drawn by: {', '.join(sorted(drawn))}\n")
    print(f"| model | splats | ratio | {' | '.join(COLUMNS.values())} |")
    print("|---|--:|--:|" + "--:|" * len(COLUMNS))
    for model in dict.fromkeys(each["model"] for each in found):
        rows = [each for each in found if each["model"] == model]
        for ratio in [*dict.fromkeys(each["ratio"] for each in rows), "median"]:
            some = [each for each in rows if ratio in (each["ratio"], "median")]
            cells = [f"{median(e['seconds'][name] for e in some):.2f}" for name in COLUMNS]
            print(f"| {model} | {rows[0]['splats']:,} | {ratio} | {' | '.join(cells)} |")
    for model in dict.fromkeys(each["model"] for each in found):
        peak = next(each["memory"] for each in found if each["model"] == model)
        print(f"\n{model}: the studio's processes took {peak / 1e9:.2f} GB at most.")


if __name__ == "__main__":
    main()
