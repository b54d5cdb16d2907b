"""Compare our SOG files with those of splat-transform, the format's own tool: bytes, time, PSNR.

    python benchmarks/sog.py [SCENES] [--only biker,skull] [--views 8] [--rows N] [--out FILE]
        [--bits 7] [--palette ENTRIES]

Each scene is written as `.sog` by nanogs and by splat-transform 3.7.0 (npm, see rivals.py), both
from the same `.ply` file, and both are compared with it on the views of `nanogs compare`. Seconds
are those of whole processes, with kernels compiled. Without a GPU, splat-transform takes many
minutes for the spherical harmonics of large scenes; --rows limits the splats of each scene. SCENES
is by default ../shared/scenes beside the repository.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from measurements import SCENES
from nanogs import io
from nanogs.splats import Splats
from rivals import REAL_SCENES, install, run_tool, timed


def main() -> None:
    """Print a row for each scene."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=REAL_SCENES)
    parser.add_argument("--only", default=",".join(SCENES))
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--rows", type=int, help="splats of each scene at most")
    parser.add_argument("--bits", help="as of `nanogs convert`")
    parser.add_argument("--palette", help="as of `nanogs convert`")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    options = parser.parse_args()
    install()
    print(
        "| scene | splats | SH degree | bytes | of splat-transform | | PSNR | of splat-transform |"
        " | seconds | of splat-transform |\n" + "|---" * 11 + "|"
    )
    rows = []
    for name in options.only.split(","):
        with tempfile.TemporaryDirectory() as folder:
            model = io.load(options.scenes / SCENES[name])
            if options.rows and options.rows < len(model):
                model = model.take(np.linspace(0, len(model) - 1, options.rows).astype(np.int64))
            sog_options = {"--bits": options.bits, "--palette": options.palette}
            packing = [word for pair in sog_options.items() if pair[1] for word in pair]
            rows.append(measured(name, model, Path(folder), options.views, packing))
        print(line(rows[-1]), flush=True)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n")


def measured(
    name: str, model: Splats, folder: Path, views: int, packing: list[str]
) -> dict[str, Any]:
    """Write both files of a scene; return bytes, PSNR and seconds of each."""
    ply, ours, theirs = (folder / file for file in ("scene.ply", "ours.sog", "theirs.sog"))
    io.save(model, ply)
    command = [sys.executable, "-m", "nanogs"]
    seconds, _ = timed([*command, "convert", ply, ours, "-q", *packing], {})
    other_seconds, _ = run_tool(ply, theirs)
    compared = subprocess.run(
        [*command, "compare", ply, ours, theirs, "--views", str(views), "--json"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    psnr = [entry["psnr"] for entry in json.loads(compared.stdout)["models"]]
    return {
        "scene": name,
        "splats": len(model),
        "degree": model.sh_degree,
        "bytes": [ours.stat().st_size, theirs.stat().st_size],
        "psnr": psnr[-2:],
        "seconds": [seconds, other_seconds],
    }


def line(row: dict[str, Any]) -> str:
    """Format a row of the table."""
    (own_bytes, other), (psnr, other_psnr) = row["bytes"], row["psnr"]
    seconds, other_seconds = row["seconds"]
    cells = [
        row["scene"], f"{row['splats']:,}", str(row["degree"]),
        f"{own_bytes:,}", f"{other:,}", f"{own_bytes / other - 1:+.1%}",
        f"{psnr:.2f}", f"{other_psnr:.2f}", f"{psnr - other_psnr:+.2f}",
        f"{seconds:.1f}", f"{other_seconds:.1f}",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
