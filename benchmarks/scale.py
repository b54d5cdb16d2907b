"""Test models larger than memory: make them, measure time and memory, kill runs, measure seams.

python benchmarks/scale.py make city.ply --splats 20000000 --degree 3 scene.ply ...
python benchmarks/scale.py run city.ply --max-memory 2GB --ratio 0.1
python benchmarks/scale.py lod city.ply tileset.json --max-memory 2GB
python benchmarks/scale.py kill scene.ply --given "psnr=30, block=9000" --suffix .spz
python benchmarks/scale.py kill scene.ply --lod a.rad --given "block=9000"
python benchmarks/scale.py seam scene.ply ... --blocks 4
python benchmarks/scale.py tree scene.ply ... --blocks 6
python benchmarks/scale.py chance scene.ply ... --ratios 0.01
"""

import argparse
import hashlib
import json
import math
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import nanogs
from nanogs.metrics import psnr
from nanogs.raster.rendering import render
from nanogs.source import Joined
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras

NANOGS = [sys.executable, "-m", "nanogs"]
POLL = 0.2  # seconds between measurements of memory, which take processor time themselves
FILES = "a.ssog", "a.rad"  # layouts of levels that are one file
LAYOUTS = {
    "tileset.json": "3d tiles",
    "lod-meta.json": "streamed sog",
    "a.ssog": "streamed sog archive",
    "a.rad": "spark tree",
}


def copies(scenes: list[Splats], count: int, degree: int) -> Iterator[Splats]:
    """Yield scenes side by side, slightly shifted, scaled and recoloured, `count` splats in all."""
    sizes = [float(np.quantile(np.ptp(s.means, axis=0), 0.5)) for s in scenes]
    across = math.ceil(math.sqrt(count / np.mean([len(s) for s in scenes])))
    offset = 0
    while count > 0:
        scene_number = offset % len(scenes)
        rng = np.random.default_rng(offset)
        row, column = divmod(offset, across)
        shift = np.array([column, 0, row], np.float32) * 0.7 * sizes[scene_number]
        scene = scenes[scene_number].span(0, count)
        scale = np.float32(rng.uniform(0.8, 1.2))
        sh = np.zeros((len(scene), (degree + 1) ** 2, 3), np.float32)
        bands = min(sh.shape[1], scene.sh.shape[1])
        sh[:, :bands] = scene.sh[:, :bands]
        sh[:, bands:] = rng.normal(0, 0.02, sh[:, bands:].shape)
        sh[:, 0] += rng.normal(0, 0.2, 3) + rng.normal(0, 0.02, (len(scene), 3))
        jitter = rng.normal(0, 1, scene.means.shape) * 0.1 * np.exp(scene.log_scales)
        yield Splats(
            means=(scene.means * scale + jitter + shift).astype(np.float32),
            log_scales=scene.log_scales + np.log(scale),
            quats=scene.quats,
            opacity_logits=scene.opacity_logits,
            sh=sh,
        )
        count -= len(scene)
        offset += 1


def make(args: argparse.Namespace) -> None:
    """Write a model of many copies, one copy at a time."""
    scenes = [replace(nanogs.load(path), elements=()) for path in args.scenes]
    with tempfile.TemporaryDirectory(dir=args.out.parent) as folder:
        paths = []
        for number, part in enumerate(copies(scenes, args.splats, args.degree)):
            paths.append(Path(folder, f"{number}.ply"))
            nanogs.save(part, paths[-1])
        with Joined([nanogs.open(path) for path in paths]) as whole:
            nanogs.save(whole, args.out, overwrite=True)
    print(f"{args.out}: {args.splats:,} splats, {args.out.stat().st_size:,} bytes")


def resident(root: int) -> int:
    """Return the resident bytes of a process and its children, from /proc; shared pages count once.

    Without that, a child would count twice while it is being forked and shares all pages.
    """
    total, waiting = 0, [root]
    while waiting:
        pid = waiting.pop()
        try:
            rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
            share = next(line for line in rollup.splitlines() if line.startswith("Pss:"))
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        except (OSError, StopIteration):
            continue
        total += 1024 * int(share.split()[1])
        waiting += map(int, children)
    return total


def watched(command: list[str]) -> tuple[float, float, int, str]:
    """Run a command; return its seconds, processor seconds, peak memory and output."""
    before, start, peak = os.times(), time.perf_counter(), 0
    with tempfile.TemporaryFile("w+") as out:
        child = subprocess.Popen(command, stdout=out)
        while child.poll() is None:
            peak = max(peak, resident(child.pid))
            time.sleep(POLL)
        seconds = time.perf_counter() - start
        out.seek(0)
        text = out.read()
    if child.returncode:
        raise SystemExit(f"{command} ended with {child.returncode}")
    after = os.times()
    spent = after.children_user + after.children_system
    return seconds, spent - before.children_user - before.children_system, peak, text


def run(args: argparse.Namespace) -> None:
    """Simplify a model, and print time and memory."""
    out = args.source.with_name("small.ply")
    command = [*NANOGS, "simplify", str(args.source), str(out), "--ratio", str(args.ratio)]
    command += ["--preset", args.preset, "-w", "--json"]
    if args.max_memory:
        command += ["--max-memory", args.max_memory]
    if args.threads:
        command += ["--threads", str(args.threads)]
    if args.workers:
        command += ["--workers", str(args.workers)]
    seconds, spent, peak, text = watched(command)
    report = json.loads(text)
    count, stages = report["input_count"], report["seconds"]
    print(f"{count:,} splats to {report['achieved_count']:,}, blocks: {report['blocks']}")
    print(f"{seconds:.1f} s, {1e6 * seconds / count:.2f} us a splat")
    print(f"{spent:.1f} s of processors, {1e6 * spent / count:.2f} us a splat")
    print(f"{peak / 1e6:.0f} MB resident at most, all processes together")
    print(", ".join(f"{name} {value:.1f}" for name, value in stages.items()))


def lod(args: argparse.Namespace) -> None:
    """Make levels of detail, and print time and memory."""
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        out = Path(folder) / ("" if args.name in FILES else "levels") / args.name
        command = [*NANOGS, "lod", str(args.source), str(out), "--preset", args.preset, "--json"]
        command += ["--levels", args.levels]
        for option in ("max_memory", "threads", "workers", "chunk", "sh_degree"):
            if (value := getattr(args, option)) is not None:
                command += [f"--{option.replace('_', '-')}", str(value)]
        seconds, spent, peak, text = watched(command)
    report = json.loads(text)
    count, first = report["source_count"], report["reports"][0]
    print(f"{count:,} splats to {[each['count'] for each in report['levels']]}")
    print(f"{[len(each.get('files', '.')) for each in report['levels']]} files, blocks: ", end="")
    print(first["blocks"])
    print(f"{seconds:.1f} s, {spent:.1f} s of processors, {peak / 1e6:.0f} MB resident at most")
    print(", ".join(f"{name} {value:.1f}" for name, value in first["seconds"].items()))


def kill(args: argparse.Namespace) -> None:
    """Kill and resume runs at random times; check that all results are identical."""
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        out = Path(folder) / f"small{args.suffix}"
        if args.lod:
            out = Path(folder) / (args.lod if args.lod in FILES else "levels")
        named = out if args.lod in FILES else out / args.lod
        words = ["lod", str(args.source), str(named)]
        if not args.lod:
            words = ["simplify", str(args.source), str(out), "--ratio", "0.1"]
        elif args.chunk:
            words += ["--chunk", str(args.chunk)]
        words += ["--preset", "fast"]  # the default one renders, in more memory than usual here
        command = [*NANOGS, *words, "-q", "--max-memory", args.max_memory, "--resume"]
        if args.given:
            call = f"simplify_blocks({str(args.source)!r}, {str(out)!r}, resume=True, {args.given})"
            if args.lod:
                arguments = f"preset='fast', layout={LAYOUTS[args.lod]!r}, {args.given}"
                call = f"write_levels({str(args.source)!r}, {str(out)!r}, resume=True, {arguments})"
            command = [sys.executable, "-c", f"import nanogs; nanogs.{call}"]
        start = time.perf_counter()
        subprocess.run(command, check=True)
        whole = time.perf_counter() - start
        expected = digest(out)
        rng, kills, results = random.Random(args.seed), 0, 0
        while kills < args.times:
            remove(out)
            while True:
                child = subprocess.Popen(command)
                try:
                    child.wait(rng.uniform(0.2, 1) * whole)
                except subprocess.TimeoutExpired:
                    child.kill()
                    child.wait()
                    kills += 1
                    if [path.name for path in Path(folder).iterdir()] != [out.name]:
                        continue  # otherwise the run was done, and only Python had not exited yet
                break
            results += 1
            if digest(out) != expected:
                raise SystemExit(f"after {kills} kills the result differs")
            if left := [path.name for path in Path(folder).iterdir() if path != out]:
                raise SystemExit(f"after {kills} kills {left} were left")
        print(f"{kills} kills, {results} results, all the same; nothing was left")


def digest(path: Path) -> dict[str, str]:
    """Return the SHA-256 of a file, or of each file in a folder, by name."""
    files = [path, *path.rglob("*")]
    return {str(f): hashlib.sha256(f.read_bytes()).hexdigest() for f in files if f.is_file()}


def remove(path: Path) -> None:
    """Remove a file or folder if it exists."""
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def seam(args: argparse.Namespace) -> None:
    """Compare blocks with the whole model: PSNR, and ratio of the error at borders to elsewhere."""
    from seams import compare

    for path in args.scenes:
        for ratio in args.ratios:
            print(path.name, ratio, compare(path, ratio, args.blocks, args.rounds), flush=True)


def tree(args: argparse.Namespace) -> None:
    """Print the PSNR of each level of a tree that is made in memory, and of one made in blocks."""
    for path in args.scenes:
        model = nanogs.load(path)
        cameras = automatic_cameras(model, args.views, width=args.pixels, height=args.pixels)
        targets = [render(model, camera).shown() for camera in cameras]
        with tempfile.TemporaryDirectory() as folder:
            for name, block in ("memory", None), ("blocks", len(model) // args.blocks):
                out = Path(folder) / f"{name}.rad"
                nanogs.write_levels(path, out, layout="spark tree", preset="fast", block=block)
                psnrs = {}
                for level, count in enumerate(nanogs.open(out).levels[1:7], 1):
                    small = nanogs.load(out, level=level)
                    shown = [render(small, camera).shown() for camera in cameras]
                    psnrs[count] = round(float(np.mean(list(map(psnr, shown, targets)))), 2)
                print(path.name, name, psnrs, flush=True)


def chance(args: argparse.Namespace) -> None:
    """Print the random variation of results in memory, to compare that of blocks with."""
    from seams import chance

    for path in args.scenes:
        for ratio in args.ratios:
            print(path.name, ratio, chance(path, ratio, args.rounds, args.times), flush=True)


def main() -> None:
    """Run the subcommand."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("make")
    one.add_argument("out", type=Path)
    one.add_argument("scenes", type=Path, nargs="+")
    one.add_argument("--splats", type=int, default=20_000_000)
    one.add_argument("--degree", type=int, default=3)
    one.set_defaults(do=make)
    one = commands.add_parser("run")
    one.add_argument("source", type=Path)
    one.add_argument("--ratio", type=float, default=0.1)
    one.add_argument("--max-memory", help="in memory without it")
    one.add_argument("--workers", type=int)
    one.add_argument("--threads", type=int)
    one.add_argument("--preset", default="fast")
    one.set_defaults(do=run)
    one = commands.add_parser("lod")
    one.add_argument("source", type=Path)
    one.add_argument("name", choices=LAYOUTS)
    one.add_argument("--levels", default="0.5,0.25,0.1,0.01")
    one.add_argument("--max-memory", help="in memory without it")
    one.add_argument("--workers", type=int)
    one.add_argument("--threads", type=int)
    one.add_argument("--chunk", type=int)
    one.add_argument("--sh-degree", type=int)
    one.add_argument("--preset", default="fast")
    one.add_argument("--folder", type=Path)
    one.set_defaults(do=lod)
    one = commands.add_parser("kill")
    one.add_argument("source", type=Path)
    one.add_argument("--times", type=int, default=100)
    one.add_argument("--lod", default="", choices=["", *LAYOUTS], help="make levels")
    one.add_argument("--chunk", type=int)
    one.add_argument("--given", help="arguments of simplify_blocks or write_levels, in Python")
    one.add_argument("--suffix", default=".ply", help="of what it writes")
    one.add_argument("--max-memory", default="225MB")
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--folder", type=Path)
    one.set_defaults(do=kill)
    one = commands.add_parser("seam")
    one.add_argument("scenes", type=Path, nargs="+")
    one.add_argument("--ratios", type=float, nargs="+", default=[0.1, 0.01])
    one.add_argument("--blocks", type=int, default=4)
    one.add_argument("--rounds", type=int, default=3)
    one.set_defaults(do=seam)
    one = commands.add_parser("tree")
    one.add_argument("scenes", type=Path, nargs="+")
    one.add_argument("--blocks", type=int, default=6)
    one.add_argument("--views", type=int, default=4)
    one.add_argument("--pixels", type=int, default=240)
    one.set_defaults(do=tree)
    one = commands.add_parser("chance")
    one.add_argument("scenes", type=Path, nargs="+")
    one.add_argument("--ratios", type=float, nargs="+", default=[0.1, 0.01])
    one.add_argument("--rounds", type=int, default=3)
    one.add_argument("--times", type=int, default=8)
    one.set_defaults(do=chance)
    args = parser.parse_args()
    args.do(args)


if __name__ == "__main__":
    main()
