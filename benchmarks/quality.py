"""Produce the table kept in docs/results.md: our methods and other tools on real scenes.

    python benchmarks/quality.py [SCENES] [--out build/quality] [--only biker,skull] [--ablations]
        [--ratios 0.1,0.01]

SCENES, or the environment variable NANOGS_SCENES, is the folder of the scenes; by default
../shared/scenes beside the repository. Node 22 and splat-transform 3.7.0 are installed by npm into
build/; splat-transform converts every scene to .ply, so that all tools start from the same file,
and simplifies it, uniformly and adaptively, on the CPU. Its seconds are those of its process,
reading and writing included; ours are the method's alone.

The table, the rows and a plot are written to --out; the table is the one to keep.
"""

import argparse
import json
import os
import shlex
import sys
from pathlib import Path

from nanogs.bench.methods import ABLATIONS, all_methods
from nanogs.bench.output import ResultFolder
from nanogs.bench.preamble import preamble
from nanogs.bench.protocol import run_bench
from nanogs.bench.rows import BenchRow
from nanogs.bench.scenes import BenchScene
from nanogs.bench.settings import RATIOS, BenchSettings
from nanogs.io import inspect
from nanogs.simplify.target import target_count
from rivals import BUILD, ROOT, install, run_tool

SPLAT_TRANSFORM = {"st-uniform": "--decimate", "st-adaptive": "--decimate-adaptive"}
PEERS = ("nanogs-ref", "st-uniform", "st-adaptive")  # files that were made beforehand
SCENES = {
    "biker": "biker.compressed.ply",
    "skull": "skull.sog",
    "plant": "plant.splat",
    "seal": "seal.splat",
    "chair": "chair.splat",
    "flowers": "flowers/lod-meta.json",
    "guitar": "guitar.compressed.ply",
    "kitchen": "kitchen.spz",
    "playbot": "playbot/lod-meta.json",
}
UP = {"chair": (0.0, 0.0, 1.0)}  # where the model itself does not show it
PHOTOS = {"chair": "chair_photos"}


def main() -> None:
    """Install, convert, simplify with the other tool, then measure everything."""
    options = arguments()
    names = options.only.split(",") if options.only else list(SCENES)
    ratios = tuple(float(text) for text in options.ratios.split(","))
    install()
    models = {name: convert(name, options.scenes / SCENES[name]) for name in names}
    for name, model in models.items():
        for ratio in ratios:
            for method, flag in SPLAT_TRANSFORM.items():
                target = BUILD / f"{name}_{ratio:g}_{method}.ply"
                if not (options.reuse and target.exists()):
                    decimate(model, target, ratio, flag)
    scenes = [BenchScene(name, model, up=UP.get(name)) for name, model in models.items()]
    scenes += [
        BenchScene(f"{name}-photographs", models[name], options.scenes / folder)
        for name, folder in PHOTOS.items()
        if name in models
    ]
    measure(scenes, ratios, options)


def arguments() -> argparse.Namespace:
    """What the caller wants."""
    default = os.environ.get("NANOGS_SCENES", ROOT.parent / "shared" / "scenes")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=Path(default))
    parser.add_argument("--peers", type=Path, help="default: peers beside the scenes")
    parser.add_argument("--out", type=Path, default=BUILD / "results")
    parser.add_argument("--only", help="names of scenes, with commas between")
    parser.add_argument("--ratios", default=",".join(map(str, RATIOS)))
    parser.add_argument(
        "--reuse", action="store_true", help="take the other tool's files of an earlier run"
    )
    parser.add_argument("--methods", help="of ours, with commas between; default: all")
    parser.add_argument("--kept", default=",".join(PEERS), help="which peers, with commas between")
    parser.add_argument("--ablations", action="store_true", help="in place of all methods")
    return parser.parse_args()


def measure(
    scenes: list[BenchScene], ratios: tuple[float, ...], options: argparse.Namespace
) -> None:
    """Run the protocol, and say on stderr how far it is."""
    peers = options.peers or options.scenes.parent / "peers"
    externals = {name: str(BUILD / f"{{model}}_{{ratio}}_{name}.ply") for name in SPLAT_TRANSFORM}
    kept = [name for name in options.kept.split(",") if name]
    externals |= {f"{name}, kept": str(peers / f"{{model}}_{{ratio}}_{name}.ply") for name in kept}
    methods = ABLATIONS if options.ablations else all_methods()
    if options.methods:
        methods = tuple(options.methods.split(","))
    settings = BenchSettings(ratios=ratios, methods=methods, externals=externals)
    folder = ResultFolder(options.out, overwrite=True)

    def on_row(row: BenchRow) -> None:
        folder.add(row)
        print(row.scene, row.method, f"{row.ratio:g}", row.psnr, row.reason, file=sys.stderr)

    command = shlex.join(["python", "benchmarks/quality.py", *sys.argv[1:]])
    folder.finish(run_bench(scenes, settings, on_row=on_row), preamble(settings, command))
    print(folder.path / "results.md")


def convert(name: str, source: Path) -> Path:
    """The scene as .ply, level 0 where there are levels."""
    target = BUILD / "scenes" / f"{name}.ply"
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        level = ["-L", "0"] if source.name == "lod-meta.json" else []
        fresh = target.with_name(f"new.{target.name}")
        run_tool(*level, source, fresh)
        fresh.replace(target)
    return target


def decimate(model: Path, target: Path, ratio: float, flag: str) -> None:
    """Simplify with the tool and note seconds and memory where the protocol finds them."""
    note = target.with_name(target.name + ".json")
    count = target_count(inspect(model).splats, ratio, None)
    seconds, peak = run_tool(model, flag, str(count), target)
    note.write_text(json.dumps({"seconds": seconds, "peak_memory": peak}))


if __name__ == "__main__":
    main()
