"""Running other programs: time and peak memory of a process, and splat-transform from npm."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
REAL_SCENES = Path(os.environ.get("NANOGS_SCENES", ROOT.parent / "shared" / "scenes"))
# Cache of results and measurements, shared by all checkouts of the repository.
BUILD = Path(os.environ.get("NANOGS_BENCHMARKS", Path.home() / ".cache" / "nanogs-benchmarks"))
RIVALS = {"st-uniform": "--decimate", "st-adaptive": "--decimate-adaptive"}
PACKAGES = ROOT / "tests" / "npm"  # package.json with the versions of splat-transform and Node
NPM = BUILD / "npm"


def install() -> None:
    """Install Node and splat-transform from npm, once."""
    NPM.mkdir(parents=True, exist_ok=True)
    if not splat_transform().exists():
        for name in ("package.json", "package-lock.json"):
            shutil.copy(PACKAGES / name, NPM / name)
        subprocess.run(["npm", "ci", "--prefix", NPM], check=True, stdout=sys.stderr)


def splat_transform() -> Path:
    """Return the path of splat-transform: the tests' copy if it exists, else that of `install`."""
    candidates = [
        folder / "node_modules" / ".bin" / "splat-transform" for folder in (PACKAGES, NPM)
    ]
    return next((path for path in candidates if path.exists()), candidates[-1])


def rival_version() -> str:
    """Return the version of splat-transform that package.json requests."""
    packages = json.loads((PACKAGES / "package.json").read_text())
    return f"splat-transform {packages['dependencies']['@playcanvas/splat-transform']}"


def run_tool(*arguments: str | Path) -> tuple[float, int]:
    """Run splat-transform on the CPU; return its seconds and peak resident bytes."""
    binaries = f"{splat_transform().parent}{os.pathsep}{os.environ['PATH']}"
    return timed([splat_transform(), "-q", "-w", "-g", "cpu", *arguments], {"PATH": binaries})


def timed(command: list[str | Path], environment: dict[str, str]) -> tuple[float, int]:
    """Run a process; return its seconds and peak resident bytes. A failure ends the benchmark."""
    start = time.perf_counter()
    process = subprocess.Popen(command, env={**os.environ, **environment}, stdout=sys.stderr)
    peak = 0
    while process.poll() is None:
        peak = max(peak, _resident_peak(process.pid))
        time.sleep(0.02)
    if process.returncode:
        sys.exit(f"{' '.join(map(str, command))}: exit {process.returncode}")
    return time.perf_counter() - start, peak


def _resident_peak(pid: int) -> int:
    """Return the peak resident bytes of a process so far; 0 if the system does not report it."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    peaks = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
    return int(peaks[0]) * 1024 if peaks else 0
