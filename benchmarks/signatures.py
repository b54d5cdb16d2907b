"""Make `src/nanogs/kernels/signatures.txt`: the kernels and types that commands compile, in order.

    python benchmarks/signatures.py [--check]

Runs commands, and records the kernels that they compile or load from the cache. Run it when a
kernel is new or its arguments change; `tests/test_warm.py` fails then. With --check it writes
nothing, and fails if the table is out of date.
"""

import argparse
import json
import os
import runpy
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numba import types
from numba.core import sigutils

import nanogs
import nanogs.ahead
from nanogs.datasets.synthetic import make_scene
from nanogs.kernels.cached import _Cache
from nanogs.views.automatic import automatic_cameras

TABLE = Path(nanogs.__file__).parent / "kernels" / "signatures.txt"
SMALL = "simplify scene.ply small.ply -w --ratio 0.1"
# Commands by mark: d(efault), f(ast), p(aper), and - for kernels that only other commands need.
RUNS = {
    "d": [SMALL],
    "f": [f"{SMALL} --preset fast"],
    "p": [f"{SMALL} --preset paper"],
    "-": [
        f"{SMALL} --preset best --steps 8",
        f"{SMALL} --cameras transforms.json",
        "simplify scene.ply small.sog -w --psnr 20",
        "convert scene.ply scene.sog -w",
        "convert scene.ply scene.html -w",
        "compare scene.ply small.ply --views 2",
        "render scene.ply picture.png -w",
        "info scene.ply --views 2",
        "refit scene.ply small.ply better.ply -w --rounds 1 --views 4",
        "lod scene.ply levels --format sog",
        "lod scene.ply tiles/tileset.json",
        "lod scene.ply tree.rad",
        "simplify scene.ply small.ply -w --draw-cost 50%",
    ],
}
HEAD = """\
# Which kernels runs compile, and for which types, in the order in which a run needs them.
# First which presets do: d(efault), f(ast), p(aper); - where only other commands do.
# Made by `python benchmarks/signatures.py`.
"""


def main() -> None:
    """Write the table or check it; with --run, execute one of the commands."""
    if sys.argv[1:2] == ["--run"]:
        take_note(Path(sys.argv[2]), sys.argv[3:])
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    text = made()
    if check and text != TABLE.read_text(encoding="utf-8"):
        sys.exit("The table is another: run python benchmarks/signatures.py.")
    if not check:
        TABLE.write_text(text, encoding="utf-8")


def made() -> str:
    """Run all commands and return the table."""
    marks: dict[str, str] = {}
    with TemporaryDirectory() as name:
        folder = Path(name)
        scene = make_scene(20_000)
        nanogs.save(scene, folder / "scene.ply")
        write_cameras(scene, folder / "transforms.json")
        for mark, commands in RUNS.items():
            for command in commands:
                run(folder, command, mark)
            for line in dict.fromkeys((folder / f"{mark}.txt").read_text().splitlines()):
                marks[line] = marks.get(line, "") + mark
    lines = [f"{found.replace('-', '') or '-'} {line}\n" for line, found in marks.items()]
    return HEAD + "".join(lines)


def write_cameras(scene: nanogs.Splats, path: Path) -> None:
    """Write a camera file with a few views of the scene."""
    poses = [camera.world_to_camera for camera in automatic_cameras(scene, 6)]
    ways = [(np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])).tolist() for pose in poses]
    frames = [
        {"file_path": f"{n}.png", "transform_matrix": matrix} for n, matrix in enumerate(ways)
    ]
    data = {"camera_angle_x": 1.0, "w": 256, "h": 256, "frames": frames}
    path.write_text(json.dumps(data), encoding="utf-8")


def run(folder: Path, command: str, mark: str) -> None:
    """Run a command in a subprocess that records its kernels."""
    words = [sys.executable, __file__, "--run", str(folder / f"{mark}.txt"), *command.split()]
    environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
    result = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if result.returncode:
        sys.exit(f"nanogs {command}\n{result.stderr}")
    print(command, file=sys.stderr, flush=True)


def take_note(notes: Path, words: list[str]) -> None:
    """Run a command in this process, and write a line for each kernel that it compiles or loads."""
    load = _Cache.load_overload

    def noted(self: _Cache, asked: Any, context: Any) -> Any:  # noqa: ANN401
        function, (given, _) = self._function, sigutils.normalize_signature(asked)  # type: ignore[no-untyped-call]
        module = function.__module__.removeprefix("nanogs.kernels.")
        with notes.open("a", encoding="utf-8") as file:
            file.write(f"{module}.{function.__qualname__}({', '.join(map(text_of, given))})\n")
        return load(self, asked, context)

    nanogs.ahead.compile_ahead = lambda *_: None  # type: ignore[assignment]
    _Cache.load_overload = noted  # type: ignore[method-assign,assignment]
    sys.argv = ["nanogs", *words]
    runpy.run_module("nanogs", run_name="__main__", alter_sys=True)


def text_of(kind: types.Type) -> str:
    """Format a type as Numba parses it: float32[:, ::1] is a C-contiguous array."""
    if isinstance(kind, types.UniTuple):
        return f"UniTuple({text_of(kind.dtype)}, {kind.count})"
    if not isinstance(kind, types.Array):
        return {"bool": "boolean"}.get(str(kind), str(kind))
    axes = [":"] * (kind.ndim - 1) + ["::1" if kind.layout == "C" else ":"]
    assert kind.layout in "CA", kind
    return f"{text_of(kind.dtype)}[{', '.join(axes)}]"


if __name__ == "__main__":
    main()
