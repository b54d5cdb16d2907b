"""Run random commands of `nanogs` on a small scene, and report what a user should not see.

    python benchmarks/command_lines.py [--seconds 300] [--seed 1] [--case 17]

A command line has up to five options, some with values that are not valid. It must end with exit
code 0 or 2. With 0 and `--json`, it prints one JSON object; with 2, one sentence on stderr, nothing
on stdout, and every file of its folder is as it was. Whatever differs is printed with its number,
which `--case` runs again, and makes the exit status 1.
"""

import argparse
import hashlib
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import typer
from numpy.random import Generator

import nanogs
from nanogs.cli import main as nanogs_command
from nanogs.cli.app import app
from nanogs.splats import Splats

BAD = (
    "",
    "-1",
    "0",
    "nan",
    "inf",
    "x",
    "1,2",
    "1e400",
    "-",
    "é",
    "../..",
    "99999999999999999999",
    "1e30",
    "2147483648",
    "9" * 400,
)
SWITCHES = ("--json", "--quiet", "--overwrite", "--verbose", "--dry-run")
# Values of options; those of one name mean the same in every command, unless `COMMANDS` says more.
VALUES: dict[str, tuple[str, ...]] = {
    "--ratio": ("0.1", "10%", "1/3", "1", "0.004", "1e-9", "200%"),
    "--count": ("1", "20", "1k", "199", "200", "1M", "1.5"),
    "--size": ("2kB", "5kB", "900", "1MB", "1KiB", "10"),
    "--psnr": ("25", "60", "5", "1000"),
    "--draw-cost": ("0.5", "50%", "1", "0.01"),
    "--spz-version": ("3", "4", "2", "1"),
    "--palette": ("0", "16", "1024", "65536", "100000"),
    "--bits": ("4", "6", "8", "2", "12"),
    "--sh-bits": ("3", "5", "8", "1", "5,4"),
    "--spare-bits": ("0", "3", "6", "20"),
    "--device": ("cpu", "auto", "cuda", "gpu"),
    "--out-dir": ("made", "made/deep", "scene.ply"),
    "--format": (".ply", "sog", ".spz", ".xyz", "meta.json", ".gltf", "splat", "rad"),
    "--from": ("rdf", "rub", "luf", "bdr", "abc"),
    "--to": ("rdf", "rub", "luf", "rdr"),
    "--frame": ("rdf:rub", "rub", "luf:rdf", "a:b", ":", "rdf:rub:rdf"),
    "--preset": ("fast", "default", "best", "paper", "fest"),
    "--nan": ("drop", "error", "keep"),
    "--threads": ("1", "2", "1000"),
    "--k": ("3", "8", "100", "1000"),
    "--lambda-app": ("0", "1", "1e30"),
    "--lambda-geo": ("0", "1", "1e30"),
    "--balance": ("0", "1", "0.3", "2"),
    "--rounds": ("0", "1", "3"),
    "--steps": ("0", "1", "3"),
    "--views": ("2", "4", "1"),
    "--view-size": ("16", "64", "1"),
    "--pixels": ("32", "48x16", "16x48", "1", "32,48", "x", "0x5"),
    "--sizes": ("32", "48x16", "32,16", "32,32", "1"),
    "--tau": ("0", "0.1", "1"),
    "--samples": ("1", "8"),
    "--seed": ("0", "7"),
    "--merge-cap": ("0.1", "0.5", "1"),
    "--cameras": ("auto", "roam", "inside", "orbit", "auto,roam", "cams.json", "none.json", "."),
    "--up": ("0,0,1", "0,-1,0", "1e-200,0,0", "z", "-y", "0,0,0", "1,2", "nan,0,1", "1e400,0,0"),
    "--sh-degree": ("0", "1", "3", "4"),
    "--render-mode": ("default", "mip", "other"),
    "--crop": ("box:-1,-1,-1,1,1,1", "sphere:0,0,0,1", "box:5,5,5,6,6,6", "sphere:9,9,9,0.1",
               "box:1,1,1,0,0,0", "box:nan,0,0,1,1,1", "sphere:0,0,0,1e400", "box:0,0,0"),
    "--min-opacity": ("0.1", "0.9", "1", "2"),
    "--max-memory": ("4GB", "1GB", "1MB", "10"),
    "--job": ("job", "made/job", "scene.ply"),
    "--scratch": ("scratch", "memory://x", "nothing://x", "scene.ply"),
    "--workers": (),
    "--scheduler": (),
    "--patience": ("0", "1"),
    "--levels": ("0.5,0.1", "1,0.5", "0.1", "0.1,0.5", "1,1", "2"),
    "--chunk": ("10", "50", "1000", "1"),
    "--chunk-min": ("1", "5", "100"),
    "--environment": ("auto", "none", "few.ply", "nothing.ply"),
    "--environment-ratio": ("0.5", "1", "0"),
    "--longitude": ("8.5", "-180", "400"),
    "--latitude": ("47", "-90", "100"),
    "--height": ("400", "-1e9"),
    "--heading": ("90", "720"),
    "--pitch": ("10",),
    "--roll": ("10",),
    "--transform": (",".join(["1,0,0,0", "0,1,0,0", "0,0,1,0", "5,6,7,1"]), "1,2,3"),
    "--level": ("0", "1", "9"),
    "--packed": (".sog", "spz,sog", ".ply", ".xyz"),
    "--photos": ("photos", ".", "nothing"),
    "--images": ("images", "x"),
    "--split": ("test", "train", "val"),
    "--background": ("white", "black", "#f08010", "0.5,0.5,0.5", "red"),
    "--report": ("page.html", "page.txt", "made/page.html"),
    "--output": ("page.html", "page.png", "made/page.html"),
    "--metrics": ("flip", "lpips", "flip,lpips", "psnr"),
    "--budget": ("10", "1M", "0"),
}  # fmt: skip
MODELS = ("scene.ply", "few.ply", "scene.sog", "scene.spz", "scene.splat", "levels/lod-meta.json",
          "lod.rad", "text.ply", "none.ply", "empty.ply")  # fmt: skip
OUTPUTS = ("out.ply", "out.sog", "out.spz", "out.splat", "out.compressed.ply", "out.glb", "out.npz",
           "out.ksplat", "out.rad", "out.usdz", "out.html", "new/out.ply", "few.ply", "out.xyz",
           "out", "levels")  # fmt: skip
LAYOUTS = ("out", "out.ssog", "out.rad", "out/lod-meta.json", "out/tileset.json", "levels",
           "few.ply", "out.ply")  # fmt: skip
# Arguments of each command, one value of each.
COMMANDS: dict[str, tuple[Sequence[str], ...]] = {
    "simplify": (MODELS, OUTPUTS),
    "lod": (MODELS, LAYOUTS),
    "refit": (MODELS, MODELS, OUTPUTS),
    "convert": (MODELS, OUTPUTS),
    "info": (MODELS,),
    "presets": (),
    "render": (MODELS, ("pictures", "new/pictures", "out.png", "few.ply")),
    "compare": (MODELS, MODELS),
    "demo": (OUTPUTS,),
    "bench": (MODELS,),
    "view": (MODELS,),
}
ALWAYS = {  # what keeps a command short, or from opening a window
    "view": ["--output", "page.html"],
    "bench": ["--ratios", "0.5", "--methods", "fast", "--views", "1", "--out", "results"],
    "demo": ["--count", "100"],
}
SHORT = {"--views": "2", "--view-size": "32", "--steps": "1", "--rounds": "1", "--pixels": "32"}


def main() -> None:
    """Run commands until the time is over, and print what was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=300, help="how long to go on")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn")
    parser.add_argument("--case", type=int, help="run this one alone, and print what it prints")
    options = parser.parse_args()
    end, found = time.monotonic() + options.seconds, 0
    known, ends = options_of_commands(), dict[int | str, int]()
    with tempfile.TemporaryDirectory() as folder:
        clean = Path(folder) / "clean"
        make_files(clean)
        case = (options.case or 1) - 1
        while time.monotonic() < end:
            case += 1
            line = random_line(np.random.default_rng([options.seed, case]), known)
            work = Path(folder) / "work"
            shutil.copytree(clean, work)
            code, printed, said, wrong = run(line, work)
            ends[code] = ends.get(code, 0) + 1
            if options.case:
                print(shlex.join(line), code, printed, said, sep="\n")
            for what in wrong:
                found += 1
                print(f"case {case}: nanogs {shlex.join(line)}\n    {what}", flush=True)
            shutil.rmtree(work)
            if options.case:
                break
    print(f"{sum(ends.values()):,} commands, exit codes {ends}, {found} failures")
    sys.exit(bool(found))


def options_of_commands() -> dict[str, list[tuple[str, bool]]]:
    """Return the options of each command, and whether each is a switch."""
    group = typer.main.get_command(app)
    return {
        name: [
            (option, bool(getattr(each, "is_flag", False)))
            for each in command.params
            if each.param_type_name == "option"
            for option in (*each.opts[-1:], *each.secondary_opts)
            if option != "--ablations"  # takes minutes
        ]
        for name, command in vars(group)["commands"].items()
    }


def make_files(folder: Path) -> None:
    """Write the models and cameras that commands name."""
    folder.mkdir()
    random = np.random.default_rng(0)
    scene = Splats(
        means=random.normal(size=(200, 3)).astype(np.float32),
        log_scales=random.normal(-2, 0.5, (200, 3)).astype(np.float32),
        quats=random.normal(size=(200, 4)).astype(np.float32),
        opacity_logits=random.normal(1, 2, 200).astype(np.float32),
        sh=random.normal(0, 0.5, (200, 4, 3)).astype(np.float32),
    )
    for name in ("scene.ply", "scene.sog", "scene.spz", "scene.splat"):
        nanogs.save(scene, folder / name)
    nanogs.save(scene.take(np.arange(40)), folder / "few.ply")
    nanogs.write_levels(
        scene, folder / "levels", [1, 0.3], layout="streamed sog", chunk=50, preset="fast"
    )
    nanogs.write_levels(scene, folder / "lod.rad", layout="spark tree", preset="fast")
    (folder / "text.ply").write_text("this is no model\n")
    (folder / "empty.ply").write_bytes(b"")
    camera = {
        "id": 0, "img_name": "a", "width": 32, "height": 32, "fx": 30.0, "fy": 30.0,
        "position": [0, 0, -6], "rotation": np.eye(3).tolist(),
    }  # fmt: skip
    (folder / "cams.json").write_text(json.dumps([camera]))


def random_line(random: Generator, known: dict[str, list[tuple[str, bool]]]) -> list[str]:
    """Return a random command line, without the name of the program."""

    def one(values: Sequence[str]) -> str:  # the first most often
        return str(values[int(random.integers(len(values), size=2).min())])

    name = str(random.choice(list(COMMANDS)))
    arguments = [one(values[:6] if random.random() < 0.9 else values) for values in COMMANDS[name]]
    given: dict[str, str | None] = {}
    every = dict(known[name])
    for option in random.permutation(list(every))[: random.integers(6)]:
        flag = every[str(option)]
        bad = random.random() < 0.06 or not VALUES.get(str(option), BAD)
        given[str(option)] = None if flag else one(BAD if bad else VALUES.get(str(option), BAD))
    if name == "simplify" and not {"--ratio", "--count", "--size", "--psnr"} & given.keys():
        given["--ratio"] = "0.3"
    short = {each: value for each, value in SHORT.items() if each in every and each not in given}
    short = {} if name == "view" else short  # where these need other options
    if (
        "--preset" not in every
        or given.get("--preset") in ("default", "best")
        or "--views" in given
    ):
        given.update(short)
    elif "--preset" not in given:
        given["--preset"] = "fast"
    if "--json" in every and random.random() < 0.3:
        given["--json"] = None
    pairs = [[option] if value is None else [option, value] for option, value in given.items()]
    return [name, *arguments, *ALWAYS.get(name, []), *[each for pair in pairs for each in pair]]


def run(line: list[str], folder: Path) -> tuple[int | str, str, str, list[str]]:
    """Run a command in a folder; return its exit code, what it printed, and what is wrong."""
    before = contents(folder)
    code, printed, said = captured(nanogs_command, line, folder)
    after = contents(folder)
    wrong = []
    if code not in (0, 2, 3):  # 3: a PSNR or draw cost was not reached
        wrong.append(f"ended with {code}: {said.strip()[-300:]}")
    several = "--out-dir" in line  # those that succeed are written, and those that fail are named
    if code == 2 and not several:
        message = re.sub(r"^\d+/\d+ .*\n", "", said, flags=re.MULTILINE)
        if not message.startswith("error: ") or message.count("\n") != 1:
            wrong.append(f"not one sentence: {message!r}")
        if printed:
            wrong.append(f"printed {printed[:200]!r}")
        changed = sorted(
            key for key in before.keys() | after.keys() if before.get(key) != after.get(key)
        )
        if changed:
            wrong.append(f"refused ({message.strip()!r}), and changed {changed}")
    if code == 0 and "--json" in line:
        try:
            json.loads(printed)
        except ValueError:
            wrong.append(f"no JSON: {printed[:200]!r}")
    if "Warning" in said or "Traceback" in said:
        wrong.append(f"said {said[-500:]!r}")
    if code == 0 and "--overwrite" not in line and "-w" not in line:
        lost = [key for key in before if after.get(key) != before[key]]
        if lost:
            wrong.append(f"changed {lost}")
    return code, printed, said, wrong


def contents(folder: Path) -> dict[str, str]:
    """Return a hash of each file, by its path; folders have an empty one."""
    return {
        str(path.relative_to(folder)): (
            hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        )
        for path in sorted(folder.rglob("*"))
    }


def captured(
    call: Callable[[], object], line: list[str], folder: Path
) -> tuple[int | str, str, str]:
    """Run the command with its output in files; return the exit code or error, and both texts."""
    argv, where = sys.argv, Path.cwd()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush()
        sys.stderr.flush()
        kept = [os.dup(1), os.dup(2)]
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        sys.argv = ["nanogs", *line]
        os.chdir(folder)
        code: int | str = "no exit"
        try:
            call()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else str(ended.code)
        except BaseException as error:  # what is searched for
            code = f"{type(error).__name__}: {error}"
        finally:
            os.chdir(where)
            sys.argv = argv
            sys.stdout.flush()
            sys.stderr.flush()
            for number, saved in enumerate(kept, 1):
                os.dup2(saved, number)
                os.close(saved)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode(errors="replace"))
    return code, texts[0], texts[1]


if __name__ == "__main__":
    main()
