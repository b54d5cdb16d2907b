"""Fuzz the readers: damage thousands of files of each format, and check how they are read.

    python benchmarks/mutate.py [--count 10000] [--seed 1] [--only .sog,.npz] [--out FILE]

Each file must be read as a model or refused with a `FormatError`, in less than ten seconds of
processor time, and in less memory than four times its size plus 200 MB; warnings are errors.
Otherwise the format's run stops, and its last file is kept in build/mutated. Each format has a
separate process, so that a crash is noticed. `tests/fuzz_seeds.py` has the files and the mutations
that damage them. Memory is the peak resident memory while one file is read and described; only
Linux reports it.
"""

import argparse
import faulthandler
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "build" / "mutated"
TIMEOUT = 10  # seconds of processor time for one file
STUCK = 600  # seconds of wall-clock time, for a file whose reader hangs without using the processor
FREE_BYTES = 200 << 20
TIMES = 4
SELF = Path("/proc/self")


def main() -> None:
    """Run all formats and print a table."""
    options = _options()
    sys.path.insert(0, str(ROOT / "tests"))
    if options.worker:
        print(json.dumps(run_format(options.only, options.count, options.seed, options.worker)))
        return
    import fuzz_seeds

    results = []
    print(
        "| format | files | models | refused | slowest | most memory |\n|---|---|---|---|---|---|"
    )
    for name in options.only.split(",") if options.only else fuzz_seeds.FORMATS:
        results.append(_in_a_process(name, options.count, options.seed))
        print(_line(results[-1]), flush=True)
    if options.out:
        options.out.write_text(json.dumps(results, indent=2) + "\n")
    sys.exit(any(result["failure"] for result in results))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="files of each format")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn")
    parser.add_argument("--only", help="formats, with commas between")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def _line(result: dict[str, Any]) -> str:
    if result["failure"]:
        return f"| {result['format']} | **{result['failure']}** |"
    files = f"{result['models'] + result['refused']:,} | {result['models']:,}"
    peaks = f"{result['seconds'] * 1e3:.0f} ms | {result['bytes'] / 1e6:.0f} MB"
    return f"| {result['format']} | {files} | {result['refused']:,} | {peaks} |"


def _in_a_process(name: str, count: int, seed: int) -> dict[str, Any]:
    """Run one format in a subprocess; if it fails, the last file is kept."""
    with tempfile.TemporaryDirectory() as folder:
        ran = subprocess.run(
            [sys.executable, __file__, "--worker", folder, "--only", name, "--count", str(count),
             "--seed", str(seed)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if ran.returncode == 0:
            result: dict[str, Any] = json.loads(ran.stdout)
        else:
            last = ran.stderr.strip().splitlines()[-1:] or [""]
            result = {"format": name, "failure": f"ended with {ran.returncode}: {last[0][:200]}"}
        if result["failure"]:
            kept = KEPT / name.replace(" ", "_").replace(",", "")
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept)
            (kept / "stderr.txt").write_text(ran.stderr)
    return result


def run_format(name: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Damage and read files of a format; return the figures, with the failure if there was one.

    Args:
        name: A format of `fuzz_seeds.FORMATS`.
        count: Number of files.
        seed: Seed of the random numbers.
        folder: Folder for one file at a time.
    """
    import fuzz_seeds
    from damage import outcome

    warnings.simplefilter("error")
    faulthandler.register(signal.SIGPROF, chain=True)
    damaged_format, rng = fuzz_seeds.format_named(name), np.random.default_rng(seed)
    # First, so that time and memory of imports and tables are not measured.
    for files in damaged_format.seeds:
        assert outcome(_placed(folder, files)) == "model"
    found = {"model": 0, "refused": 0}
    slowest, peak, failure = 0.0, 0, ""
    for number in range(count):
        files = damaged_format.damaged(rng)
        path = _placed(folder, files)
        before, start = _resident(reset=True), time.process_time()
        faulthandler.dump_traceback_later(STUCK, exit=True)
        signal.setitimer(signal.ITIMER_PROF, TIMEOUT)  # ends the process, even within C code
        found[outcome(path)] += 1
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
        slowest = max(slowest, time.process_time() - start)
        took, size = _resident() - before, sum(map(len, files.values()))
        peak = max(peak, took)
        if took > TIMES * size + FREE_BYTES:
            failure = f"file {number}: {took:,} bytes of memory for one of {size:,}"
            break
    return {
        "format": name,
        "models": found["model"],
        "refused": found["refused"],
        "seconds": slowest,
        "bytes": peak,
        "failure": failure,
    }


def _placed(folder: Path, files: dict[str, bytes]) -> Path:
    """Empty the folder, write the files of a model into it, and return the first."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
    return folder / next(iter(files))


def _resident(*, reset: bool = False) -> int:
    """Return the peak resident memory, bytes, since the last reset; 0 if it is not reported."""
    if not SELF.exists():
        return 0
    if reset:
        (SELF / "clear_refs").write_text("5")
    status = (SELF / "status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) << 10


if __name__ == "__main__":
    main()
