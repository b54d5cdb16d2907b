"""Check that results of `nanogs simplify --psnr` have the requested PSNR by `nanogs compare`.

    python benchmarks/psnr.py biker.spz=35 playbot.ply=35,30 --presets default,fast

Both are run as separate commands with default options; results are written as .ply files, or in the
format of `--format`. Prints a table in Markdown.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

LIMIT = 900  # seconds; time-out of a command


def main() -> None:
    """Measure each scene with each preset and print its row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", help="MODEL=dB,dB,...")
    parser.add_argument("--presets", default="default,fast")
    parser.add_argument("--format", default="ply")
    options = parser.parse_args()
    print("| scene | preset | asked | simplify says | compare says | splats | counts tried | end |")
    print("|---|---|--:|--:|--:|--:|--:|---|")
    with TemporaryDirectory() as folder:
        for scene in options.scenes:
            model, _, targets = scene.rpartition("=")
            for target in targets.split(","):
                for preset in options.presets.split(","):
                    out = Path(folder) / f"small.{options.format}"
                    print(_row(Path(model), target, preset, out), flush=True)


def _row(model: Path, target: str, preset: str, out: Path) -> str:
    run = _nanogs("simplify", model, out, "-w", "--psnr", target, "--preset", preset)
    reported_psnr = float(run["judged"]["psnr"])
    [compared] = _nanogs("compare", model, out)["models"]
    name = model.parent.name if model.suffix == ".json" else model.name.split(".")[0]
    counts, probe_count = f"{run['achieved_count']:,}", f"{len(run['probes'])}"
    cells = [
        name, preset, target, f"{reported_psnr:.2f}", f"{float(compared['psnr']):.2f}", counts,
        probe_count,
    ]  # fmt: skip
    return f"| {' | '.join([*cells, run['stop']])} |"


def _nanogs(*words: object) -> dict[str, Any]:
    """Run a command of nanogs and return its JSON."""
    command = [sys.executable, "-m", "nanogs", *map(str, words), "--json"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    if result.returncode not in (0, 3):  # 3: the request was not met, and the report says so
        raise SystemExit(result.stderr)
    report: dict[str, Any] = json.loads(result.stdout)
    return report


if __name__ == "__main__":
    main()
