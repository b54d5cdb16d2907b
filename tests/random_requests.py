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
FEW_VIEWS = {"views": 2, "view_size": 48, "around": 0, "steps": 2}
# Notes that say why a file is small.
SMALL_FILE_NOTES = ("whole model fits", "of the requested size, because a file of")


@dataclass(frozen=True, slots=True)
class Request:
    """A request for a size or a PSNR, and the model to simplify.

    Attributes:
        model: Name of the kind of model.
        splats: The model.
        suffix: Suffix of the format.
        preset: Name of the preset.
        goal: `size` in bytes or `psnr` in dB.
        arguments: Further arguments of `simplify`.
        options: Options of the format.
        frame: Source and target frame of a conversion, or None.
        mode: How it is run: "memory", "file", "blocks" or "command".
        block: Number of splats in a block.
    """

    model: str
    splats: Splats
    suffix: str
    preset: str
    goal: dict[str, Any]
    arguments: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    frame: tuple[str, str] | None = None
    mode: str = "memory"
    block: int | None = None

    def __str__(self) -> str:
        asked = {**self.goal, **self.arguments, **self.options}
        text = ", ".join(
            f"{name}={value}" for name, value in asked.items() if name not in FEW_VIEWS
        )
        model = f"{self.model} ({len(self.splats)} of degree {self.splats.sh_degree})"
        more = f" frame={self.frame}" * bool(self.frame) + f" block={self.block}" * bool(self.block)
        return f"{model} as {self.suffix}, {self.preset}, {self.mode}: {text}{more}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a request.

    Attributes:
        used_fraction: Bytes of the file divided by the requested size, or None without one.
        error: The error message if it was refused, or an empty text.
        faults: The faults that were found, or an empty text.
        whole: Whether the whole model fits.
    """

    used_fraction: float | None = None
    error: str = ""
    faults: str = ""
    whole: bool = False


# ---- models ------------------------------------------------------------------------------------


def _ordinary(rng: np.random.Generator) -> Splats:
    count = int(np.exp(rng.uniform(np.log(2), np.log(1500))))
    return random_splats(count, degree=int(rng.integers(0, 4)), seed=int(rng.integers(1 << 30)))


def _one(rng: np.random.Generator) -> Splats:
    return random_splats(1, degree=int(rng.integers(0, 4)), seed=int(rng.integers(1 << 30)))


def _equal(rng: np.random.Generator) -> Splats:
    return _one(rng).take(np.zeros(int(rng.integers(2, 400)), np.int64))


def _transparent(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    return replace(splats, opacity_logits=np.full(len(splats), rng.choice([-40.0, -np.inf])))


def _nan_rows(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    splats.sh[rng.random(len(splats)) < 0.3, 0, 0] = np.nan
    splats.means[rng.random(len(splats)) < 0.1] = np.inf
    return splats


def _huge(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    return replace(splats, log_scales=splats.log_scales + rng.choice([5, 20, 40]))


def _tiny(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    return replace(splats, log_scales=splats.log_scales - rng.choice([5, 20, 80]))


def _mixed(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    return replace(splats, log_scales=splats.log_scales + rng.normal(0, 8, (len(splats), 1)))


def _line(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    splats.means[:, 1:] = 0
    return splats


def _far(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    return replace(splats, means=splats.means + np.float32(rng.choice([1e3, 1e6])))


def _one_spot(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    splats.means[:] = splats.means[0]
    return splats


def _extras(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    count = len(splats)
    extras = {"label": np.arange(count, dtype=np.int16), "weight": np.ones(count, np.float64)}
    rows = np.zeros(int(rng.integers(1, 9)), dtype=[("a", "f8"), ("b", "u1")])
    elements = (ExtraElement("camera", rows),) if rng.random() < 0.5 else ()
    return replace(splats, extras=extras, elements=elements, comments=("made up",))


def _antialiased(rng: np.random.Generator) -> Splats:
    return replace(_ordinary(rng), render_mode=RenderMode.MIP)


def _dull(rng: np.random.Generator) -> Splats:
    splats = _ordinary(rng)
    splats.sh[:, 1:] *= np.float32(rng.choice([0, 1e-3]))
    return splats


MODELS: dict[str, Callable[[np.random.Generator], Splats]] = {
    "usual": _ordinary, "one splat": _one, "equal": _equal, "transparent": _transparent,
    "NaN rows": _nan_rows, "huge": _huge, "tiny": _tiny, "mixed": _mixed, "a line": _line,
    "far away": _far,
    "one spot": _one_spot, "extra columns": _extras, "antialiased": _antialiased, "dull": _dull,
}  # fmt: skip


def neighbourhood(scene: Splats, rng: np.random.Generator) -> Splats:
    """Return the nearest neighbours of a random splat of a scene."""
    count = int(np.exp(rng.uniform(np.log(20), np.log(3000))))
    centre = scene.means[rng.integers(len(scene))]
    rows = np.argsort(((scene.means - centre) ** 2).sum(1), kind="stable")[:count]
    return scene.take(np.sort(rows))


# ---- requests ----------------------------------------------------------------------------------


def random_request(
    rng: np.random.Generator, scenes: dict[str, Splats], presets: Sequence[str]
) -> Request:
    """Return a random request.

    Args:
        rng: Random numbers.
        scenes: Whole scenes by name, of which pieces are used.
        presets: Presets to choose from.
    """
    model = str(rng.choice([*MODELS, *["usual"] * 4, *scenes, *scenes]))
    splats = neighbourhood(scenes[model], rng) if model in scenes else MODELS[model](rng)
    suffix, preset = str(rng.choice(SUFFIXES)), str(rng.choice(presets))
    known = registry.writable(Path(f"a{suffix}"))
    if splats.sh_degree > known.max_degree and rng.random() < 0.7:
        splats = splats.with_sh_degree(known.max_degree)
    arguments = {} if preset == "fast" else {**FEW_VIEWS, "views": int(rng.integers(2, 4))}
    if rng.random() < 0.25:
        arguments["sh_degree"] = int(rng.integers(0, 4))
    options = {
        name: (values := option.values[:600])[rng.integers(len(values))]
        for name, option in known.options.items()
        if rng.random() < 0.2
    }
    mode = str(rng.choice(["memory", "file", "blocks", "command"], p=[0.5, 0.25, 0.22, 0.03]))
    request = Request(model, splats, suffix, preset, {}, arguments, options, mode=mode)
    if mode == "blocks":
        request = replace(request, block=max(int(len(splats) * rng.uniform(0.2, 1.2)), 1))
    if mode != "memory" and rng.random() < 0.1:
        request = replace(request, frame=FRAMES[rng.integers(len(FRAMES))])
    if rng.random() < 0.1 and suffix != ".html":
        return replace(request, goal={"psnr": float(np.round(rng.uniform(15, 45), 1))})
    return replace(request, goal={"size": _size(rng, request)})


def _size(rng: np.random.Generator, request: Request) -> int:
    finite = request.splats.take(np.flatnonzero(request.splats.finite()))
    if len(finite) == 0:
        return int(rng.integers(1, 5000))
    try:
        whole = _bytes(finite, request)
        least = _bytes(finite.take(np.arange(1)).with_sh_degree(0), request)
    except NanogsError:
        return int(np.exp(rng.uniform(np.log(100), np.log(100_000))))
    if rng.random() < 0.15:  # near the smallest
        return max(int(least * rng.uniform(0.8, 1.2)), 1)
    return max(int(np.exp(rng.uniform(np.log(0.5 * least), np.log(1.5 * whole)))), 1)


def _bytes(splats: Splats, request: Request) -> int:
    return encoded_bytes(splats, Path(f"a{request.suffix}"), request.options)


# ---- results -----------------------------------------------------------------------------------


def run_and_check(request: Request, *, check_smallest: bool = True) -> Outcome:
    """Carry out a request and check the result.

    Args:
        request: The request.
        check_smallest: Whether to test the smallest possible size as well, if an error names one.
    """
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("error")
        folder = Path(name)
        try:
            out, report = _simplified(request, folder)
        except NotEnoughMemoryError as error:
            return Outcome(error=_sentence(error))
        except NanogsError as error:
            return _check_error(request, folder, error, check_smallest=check_smallest)
        except Exception as error:
            return Outcome(faults=f"crashed: {type(error).__name__}: {error}")
        faults = "; ".join(_faults(request, folder, out, report))
        size = request.goal.get("size")
        used_fraction = out.stat().st_size / size if size else None
        return Outcome(
            used_fraction,
            faults=faults,
            whole=any(SMALL_FILE_NOTES[0] in note for note in report["notes"]),
        )


def _simplified(request: Request, folder: Path) -> tuple[Path, dict[str, Any]]:
    out, source = folder / f"out{request.suffix}", folder / "in.ply"
    asked: dict[str, Any] = {**request.goal, **request.arguments, "preset": request.preset}
    if request.mode == "memory":
        small, report = nanogs.simplify(
            request.splats, format=request.suffix, format_options=request.options, **asked
        )
        nanogs.save(small, out, format_options={**request.options, **report.format_options})
        return out, _as_json(report)
    nanogs.save(request.splats, source)
    if request.mode == "command":
        return out, _run_command(request, source, out)
    report = nanogs.simplify_blocks(
        source,
        out,
        block=request.block,
        frame=request.frame,
        format_options=request.options,
        **asked,
    )
    return out, _as_json(report)


def _as_json(report: SimplifyReport) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(report.to_dict(), default=str))
    return found


def _run_command(request: Request, source: Path, out: Path) -> dict[str, Any]:
    arguments = {**request.goal, **request.arguments, **request.options, "preset": request.preset}
    arguments = {
        name: value for name, value in arguments.items() if name not in ("view_size", "around")
    }
    words = [
        word for name, v in arguments.items() for word in (f"--{name.replace('_', '-')}", str(v))
    ]
    if request.frame:
        words += ["--frame", ":".join(request.frame)]
    result = subprocess.run(
        [sys.executable, "-m", "nanogs", "simplify", source, out, *words, "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if result.returncode == 2:
        raise NanogsError(result.stderr.strip().removeprefix("Error: ").removeprefix("error: "))
    if result.returncode not in (0, 3):
        raise RuntimeError(f"{result.returncode}: {result.stderr.strip()[-300:]}")
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def _faults(request: Request, folder: Path, out: Path, report: dict[str, Any]) -> list[str]:
    """Return the faults of a result, a few words each."""
    faults, file_bytes = [], out.stat().st_size
    left = {path.name for path in folder.iterdir()} - {"in.ply", out.name}
    if left:
        faults.append(f"left behind: {sorted(left)}")
    size = request.goal.get("size")
    if size is not None:
        if file_bytes > size:
            faults.append(f"larger than asked: {file_bytes:,} B of {size:,}")
        if report["achieved_size"] != file_bytes:
            faults.append(f"achieved_size {report['achieved_size']} is not {file_bytes}")
        explained = any(end in note for note in report["notes"] for end in SMALL_FILE_NOTES)
        if file_bytes < ENOUGH * size and not explained:
            faults.append("not said why it is small")
    elif report["stop"] == "target" and not report["judged"]["psnr"] >= request.goal["psnr"]:
        faults.append("misses the PSNR")
    if request.suffix != ".html":
        faults += _differences(request, out, report)
    return faults


def _differences(request: Request, out: Path, report: dict[str, Any]) -> list[str]:
    faults = []
    try:
        found = nanogs.load(out)
    except Exception as error:
        return [f"cannot be read: {type(error).__name__}: {error}"]
    if len(found) != report["achieved_count"]:
        faults.append(f"{len(found)} splats, and not {report['achieved_count']} as the report has")
    degree = min(request.arguments.get("sh_degree", 4), request.splats.sh_degree)
    if found.sh_degree > degree:
        faults.append(f"harmonics of degree {found.sh_degree}, and not {degree}")
    if not found.finite().all():
        faults.append("splats that are not finite")
    return faults


def _check_error(
    request: Request, folder: Path, error: NanogsError, *, check_smallest: bool
) -> Outcome:
    text = _sentence(error)
    left = {path.name for path in folder.iterdir()} - {"in.ply"}
    faults = [f"refused, left behind: {sorted(left)}"] if left else []
    if len(text) > 320 or "\n" in text or not text.endswith((".", ")")):
        faults.append("no clear sentence")
    if check_smallest and "too small" in text:
        faults += _check_smallest_size(request, text)
    return Outcome(error=text, faults="; ".join(faults) and f"{'; '.join(faults)} ({text})")


def _check_smallest_size(request: Request, text: str) -> list[str]:
    """Check that the smallest size that an error names works, and that one byte less does not."""
    numbers = NAMED_SIZE.findall(text)
    if not numbers:
        return ["no smallest size is named"]
    least = int(numbers[-1].replace(",", ""))
    if least <= request.goal["size"]:
        return [f"the smallest named, {least}, is no more than was asked for"]
    if "takes about" in text:  # a rough estimate, given before anything is computed
        found = run_and_check(replace(request, goal={"size": 2 * least}), check_smallest=False)
        small = "too small" in found.error and "splats, the fewest" not in found.error
        return [f"twice what is about the smallest: {found.error}"] if small else []
    at_smallest = run_and_check(replace(request, goal={"size": least}), check_smallest=False)
    below_smallest = run_and_check(replace(request, goal={"size": least - 1}), check_smallest=False)
    if "cannot be divided" in at_smallest.error:  # which no size can change
        return []
    faults = [f"with the smallest named: {at_smallest.faults or at_smallest.error}"] * bool(
        at_smallest.faults or at_smallest.error
    )
    if not below_smallest.error:
        faults.append(f"one byte less than the smallest named: {below_smallest.faults or 'is met'}")
    return faults


def _sentence(error: NanogsError) -> str:
    return str(error).strip()


def message_template(text: str) -> str:
    """Return a message without its numbers and paths, to count similar ones."""
    text = re.sub(r"\S*/\S*", "FILE", text)
    return re.sub(r"[\d][\d,.]*\d|\d", "N", text)
