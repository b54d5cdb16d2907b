"""Random requests for a size or a PSNR, and checks of their results."""

import json
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import nanogs
from builders import random_splats
from nanogs.errors import NanogsError, NotEnoughMemoryError
from nanogs.io import encoded_bytes, registry
from nanogs.pipeline.search.file_size import ENOUGH
from nanogs.report import SimplifyReport
from nanogs.splats import ExtraElement, RenderMode, Splats

SUFFIXES = (".sog", ".spz") * 3 + (
    ".ply", ".ply", ".compressed.ply", ".glb", ".splat", ".npz", ".usda", ".html",
)  # fmt: skip
FRAMES = (("rdf", "rub"), ("rub", "luf"))
NAMED_SIZE = re.compile(r"([\d,]+) B[.;]")
FEW = {"views": 2, "view_size": 48, "roaming": 0, "steps": 2}
# Notes that say why a file is small.
SMALL_FILE_NOTES = ("whole model fits", "of the requested size, because a file of")


@dataclass(frozen=True, slots=True)
class Wish:
    """A request for a size or a PSNR, and the model to simplify.

    Attributes:
        model: Name of the kind of model.
        splats: The model.
        suffix: Suffix of the format.
        preset: Name of the preset.
        goal: `size` in bytes or `psnr` in dB.
        given: Further arguments of `simplify`.
        options: Options of the format.
        frame: Source and target frame of a conversion, or None.
        way: How it is run: "memory", "file", "blocks" or "command".
        block: Number of splats in a block.
    """

    model: str
    splats: Splats
    suffix: str
    preset: str
    goal: dict[str, Any]
    given: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    frame: tuple[str, str] | None = None
    way: str = "memory"
    block: int | None = None

    def __str__(self) -> str:
        asked = {**self.goal, **self.given, **self.options}
        text = ", ".join(f"{name}={value}" for name, value in asked.items() if name not in FEW)
        model = f"{self.model} ({len(self.splats)} of degree {self.splats.sh_degree})"
        more = f" frame={self.frame}" * bool(self.frame) + f" block={self.block}" * bool(self.block)
        return f"{model} as {self.suffix}, {self.preset}, {self.way}: {text}{more}"


@dataclass(frozen=True, slots=True)
class Met:
    """The outcome of a request.

    Attributes:
        used: Bytes of the file divided by the requested size, or None if none was requested.
        refused: The error message if it was refused, or an empty text.
        wrong: The faults that were found, or an empty text.
        whole: Whether the whole model fits.
    """

    used: float | None = None
    refused: str = ""
    wrong: str = ""
    whole: bool = False


# ---- models ------------------------------------------------------------------------------------


def _usual(rng: np.random.Generator) -> Splats:
    count = int(np.exp(rng.uniform(np.log(2), np.log(1500))))
    return random_splats(count, degree=int(rng.integers(0, 4)), seed=int(rng.integers(1 << 30)))


def _one(rng: np.random.Generator) -> Splats:
    return random_splats(1, degree=int(rng.integers(0, 4)), seed=int(rng.integers(1 << 30)))


def _equal(rng: np.random.Generator) -> Splats:
    return _one(rng).take(np.zeros(int(rng.integers(2, 400)), np.int64))


def _clear(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    return replace(splats, opacity_logits=np.full(len(splats), rng.choice([-40.0, -np.inf])))


def _gaps(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    splats.sh[rng.random(len(splats)) < 0.3, 0, 0] = np.nan
    splats.means[rng.random(len(splats)) < 0.1] = np.inf
    return splats


def _huge(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    return replace(splats, log_scales=splats.log_scales + rng.choice([5, 20, 40]))


def _tiny(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    return replace(splats, log_scales=splats.log_scales - rng.choice([5, 20, 80]))


def _mixed(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    return replace(splats, log_scales=splats.log_scales + rng.normal(0, 8, (len(splats), 1)))


def _line(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    splats.means[:, 1:] = 0
    return splats


def _far(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    return replace(splats, means=splats.means + np.float32(rng.choice([1e3, 1e6])))


def _one_spot(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    splats.means[:] = splats.means[0]
    return splats


def _extras(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    count = len(splats)
    extras = {"label": np.arange(count, dtype=np.int16), "weight": np.ones(count, np.float64)}
    rows = np.zeros(int(rng.integers(1, 9)), dtype=[("a", "f8"), ("b", "u1")])
    elements = (ExtraElement("camera", rows),) if rng.random() < 0.5 else ()
    return replace(splats, extras=extras, elements=elements, comments=("made up",))


def _tagged(rng: np.random.Generator) -> Splats:
    return replace(_usual(rng), render_mode=RenderMode.MIP)


def _dull(rng: np.random.Generator) -> Splats:
    splats = _usual(rng)
    splats.sh[:, 1:] *= np.float32(rng.choice([0, 1e-3]))
    return splats


MODELS: dict[str, Callable[[np.random.Generator], Splats]] = {
    "usual": _usual, "one splat": _one, "equal": _equal, "transparent": _clear, "NaN rows": _gaps,
    "huge": _huge, "tiny": _tiny, "mixed": _mixed, "a line": _line, "far away": _far,
    "one spot": _one_spot, "extra columns": _extras, "antialiased": _tagged, "dull": _dull,
}  # fmt: skip


def piece(scene: Splats, rng: np.random.Generator) -> Splats:
    """Return the nearest neighbours of a random splat of a scene."""
    count = int(np.exp(rng.uniform(np.log(20), np.log(3000))))
    centre = scene.means[rng.integers(len(scene))]
    rows = np.argsort(((scene.means - centre) ** 2).sum(1), kind="stable")[:count]
    return scene.take(np.sort(rows))


# ---- requests ----------------------------------------------------------------------------------


def draw(rng: np.random.Generator, scenes: dict[str, Splats], presets: Sequence[str]) -> Wish:
    """Return a random request.

    Args:
        rng: Random numbers.
        scenes: Whole scenes by name, of which pieces are used.
        presets: Presets to choose from.
    """
    model = str(rng.choice([*MODELS, *["usual"] * 4, *scenes, *scenes]))
    splats = piece(scenes[model], rng) if model in scenes else MODELS[model](rng)
    suffix, preset = str(rng.choice(SUFFIXES)), str(rng.choice(presets))
    known = registry.writable(Path(f"a{suffix}"))
    if splats.sh_degree > known.max_degree and rng.random() < 0.7:
        splats = splats.with_sh_degree(known.max_degree)
    given = {} if preset == "fast" else {**FEW, "views": int(rng.integers(2, 4))}
    if rng.random() < 0.25:
        given["sh_degree"] = int(rng.integers(0, 4))
    options = {
        name: (values := option.values[:600])[rng.integers(len(values))]
        for name, option in known.options.items()
        if rng.random() < 0.2
    }
    way = str(rng.choice(["memory", "file", "blocks", "command"], p=[0.5, 0.25, 0.22, 0.03]))
    wish = Wish(model, splats, suffix, preset, {}, given, options, way=way)
    if way == "blocks":
        wish = replace(wish, block=max(int(len(splats) * rng.uniform(0.2, 1.2)), 1))
    if way != "memory" and rng.random() < 0.1:
        wish = replace(wish, frame=FRAMES[rng.integers(len(FRAMES))])
    if rng.random() < 0.1 and suffix != ".html":
        return replace(wish, goal={"psnr": float(np.round(rng.uniform(15, 45), 1))})
    return replace(wish, goal={"size": _size(rng, wish)})


def _size(rng: np.random.Generator, wish: Wish) -> int:
    finite = wish.splats.take(np.flatnonzero(wish.splats.finite()))
    if len(finite) == 0:
        return int(rng.integers(1, 5000))
    try:
        whole = _bytes(finite, wish)
        least = _bytes(finite.take(np.arange(1)).with_sh_degree(0), wish)
    except NanogsError:
        return int(np.exp(rng.uniform(np.log(100), np.log(100_000))))
    if rng.random() < 0.15:  # near the smallest
        return max(int(least * rng.uniform(0.8, 1.2)), 1)
    return max(int(np.exp(rng.uniform(np.log(0.5 * least), np.log(1.5 * whole)))), 1)


def _bytes(splats: Splats, wish: Wish) -> int:
    return encoded_bytes(splats, Path(f"a{wish.suffix}"), wish.options)


# ---- results -----------------------------------------------------------------------------------


def fulfil(wish: Wish, *, around: bool = True) -> Met:
    """Carry out a request and check the result.

    Args:
        wish: The request.
        around: Whether to test the smallest possible size as well, if an error names one.
    """
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("error")
        folder = Path(name)
        try:
            out, report = _made(wish, folder)
        except NotEnoughMemoryError as error:
            return Met(refused=_sentence(error))
        except NanogsError as error:
            return _refused(wish, folder, error, around=around)
        except Exception as error:
            return Met(wrong=f"crashed: {type(error).__name__}: {error}")
        wrong = "; ".join(_faults(wish, folder, out, report))
        size = wish.goal.get("size")
        used = out.stat().st_size / size if size else None
        return Met(
            used, wrong=wrong, whole=any(SMALL_FILE_NOTES[0] in note for note in report["notes"])
        )


def _made(wish: Wish, folder: Path) -> tuple[Path, dict[str, Any]]:
    out, source = folder / f"out{wish.suffix}", folder / "in.ply"
    asked: dict[str, Any] = {**wish.goal, **wish.given, "preset": wish.preset}
    if wish.way == "memory":
        small, report = nanogs.simplify(
            wish.splats, format=wish.suffix, format_options=wish.options, **asked
        )
        nanogs.save(small, out, format_options={**wish.options, **report.format_options})
        return out, _plain(report)
    nanogs.save(wish.splats, source)
    if wish.way == "command":
        return out, _commanded(wish, source, out)
    report = nanogs.simplify_blocks(
        source, out, block=wish.block, frame=wish.frame, format_options=wish.options, **asked
    )
    return out, _plain(report)


def _plain(report: SimplifyReport) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(report.to_dict(), default=str))
    return found


def _commanded(wish: Wish, source: Path, out: Path) -> dict[str, Any]:
    given = {**wish.goal, **wish.given, **wish.options, "preset": wish.preset}
    given = {name: value for name, value in given.items() if name not in ("view_size", "roaming")}
    words = [word for name, v in given.items() for word in (f"--{name.replace('_', '-')}", str(v))]
    if wish.frame:
        words += ["--frame", ":".join(wish.frame)]
    done = subprocess.run(
        [sys.executable, "-m", "nanogs", "simplify", source, out, *words, "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode == 2:
        raise NanogsError(done.stderr.strip().removeprefix("Error: ").removeprefix("error: "))
    if done.returncode not in (0, 3):
        raise RuntimeError(f"{done.returncode}: {done.stderr.strip()[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def _faults(wish: Wish, folder: Path, out: Path, report: dict[str, Any]) -> list[str]:
    """Return the faults of a result, a few words each."""
    faults, taken = [], out.stat().st_size
    left = {path.name for path in folder.iterdir()} - {"in.ply", out.name}
    if left:
        faults.append(f"left behind: {sorted(left)}")
    size = wish.goal.get("size")
    if size is not None:
        if taken > size:
            faults.append(f"larger than asked: {taken:,} B of {size:,}")
        if report["achieved_size"] != taken:
            faults.append(f"achieved_size {report['achieved_size']} is not {taken}")
        said = any(end in note for note in report["notes"] for end in SMALL_FILE_NOTES)
        if taken < ENOUGH * size and not said:
            faults.append("not said why it is small")
    elif report["stop"] == "target" and not report["judged"]["psnr"] >= wish.goal["psnr"]:
        faults.append("misses the PSNR")
    if wish.suffix != ".html":
        faults += _unlike(wish, out, report)
    return faults


def _unlike(wish: Wish, out: Path, report: dict[str, Any]) -> list[str]:
    faults = []
    try:
        found = nanogs.load(out)
    except Exception as error:
        return [f"cannot be read: {type(error).__name__}: {error}"]
    if len(found) != report["achieved_count"]:
        faults.append(f"{len(found)} splats, and not {report['achieved_count']} as the report has")
    degree = min(wish.given.get("sh_degree", 4), wish.splats.sh_degree)
    if found.sh_degree > degree:
        faults.append(f"harmonics of degree {found.sh_degree}, and not {degree}")
    if not found.finite().all():
        faults.append("splats that are not finite")
    return faults


def _refused(wish: Wish, folder: Path, error: NanogsError, *, around: bool) -> Met:
    text = _sentence(error)
    left = {path.name for path in folder.iterdir()} - {"in.ply"}
    wrong = [f"refused, left behind: {sorted(left)}"] if left else []
    if len(text) > 320 or "\n" in text or not text.endswith((".", ")")):
        wrong.append("no clear sentence")
    if around and "too small" in text:
        wrong += _smallest(wish, text)
    return Met(refused=text, wrong="; ".join(wrong) and f"{'; '.join(wrong)} ({text})")


def _smallest(wish: Wish, text: str) -> list[str]:
    """Check that the smallest size that an error names works, and that one byte less does not."""
    numbers = NAMED_SIZE.findall(text)
    if not numbers:
        return ["no smallest size is named"]
    least = int(numbers[-1].replace(",", ""))
    if least <= wish.goal["size"]:
        return [f"the smallest named, {least}, is no more than was asked for"]
    if "takes about" in text:  # a rough estimate, given before anything is computed
        found = fulfil(replace(wish, goal={"size": 2 * least}), around=False)
        small = "too small" in found.refused and "splats, the fewest" not in found.refused
        return [f"twice what is about the smallest: {found.refused}"] if small else []
    at = fulfil(replace(wish, goal={"size": least}), around=False)
    below = fulfil(replace(wish, goal={"size": least - 1}), around=False)
    if "cannot be divided" in at.refused:  # which no size can change
        return []
    wrong = [f"with the smallest named: {at.wrong or at.refused}"] * bool(at.wrong or at.refused)
    if not below.refused:
        wrong.append(f"one byte less than the smallest named: {below.wrong or 'is met'}")
    return wrong


def _sentence(error: NanogsError) -> str:
    return str(error).strip()


def kind(text: str) -> str:
    """Return a message without its numbers and paths, to count similar ones."""
    text = re.sub(r"\S*/\S*", "FILE", text)
    return re.sub(r"[\d][\d,.]*\d|\d", "N", text)
