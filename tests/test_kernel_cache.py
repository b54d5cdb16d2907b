"""The cache of compiled kernels: a change of any source file recompiles all of them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from threading import Thread

import pytest

import nanogs
from builders import random_splats
from nanogs.kernels import compiling

LOCK = """
from numba.core import caching

def refuse(*_):
    raise PermissionError("read-only")

caching._CacheLocator.ensure_cache_path = refuse
caching.IndexDataCacheFile._open_for_write = refuse
"""

LOGARITHM = f"""
import sys

import numpy as np

if "locked" in sys.argv:
    exec({LOCK!r})

from nanogs.kernels.compiling import when_compiling
from nanogs.kernels.forest import log_determinants  # soon compiled, with helpers of two files

told = []
when_compiling(lambda: told.append(1))
found = np.empty(1)
log_determinants(np.array([[2.0, 0, 0, 1, 0, 1]]), found)
print(round(float(found[0]), 3), "compiled" if told else "loaded")
"""


def copied(package, folder, *ignored):
    """Copy the package into a folder without its viewer; return the copy."""
    ignore = shutil.ignore_patterns("viewer.js", *ignored)
    return shutil.copytree(package, folder / "nanogs", ignore=ignore)


@pytest.fixture
def package(tmp_path):
    """A copy of the package, the kernels of which tests may change."""
    return copied(Path(nanogs.__file__).parent, tmp_path, "*.nbc", "*.nbi")


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory):
    """A copy of the package with the kernel of `LOGARITHM` in its cache."""
    folder = tmp_path_factory.mktemp("compiled")
    package = copied(Path(nanogs.__file__).parent, folder, "*.nbc", "*.nbi")
    assert run(package) == "0.693 compiled"
    return package


@pytest.fixture
def compiled(compiled_once, tmp_path):
    """As `package`, with the kernel of `LOGARITHM` in its cache."""
    return copied(compiled_once, tmp_path)


def environment(package):
    """Environment variables of a process that uses the kernels of this package, without SIMD."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    return kept | {"PYTHONPATH": str(package.parent), "NANOGS_SIMD": "0"}


def run(package, *arguments, **variables):
    result = subprocess.run(
        [sys.executable, "-c", LOGARITHM, *arguments],
        env=environment(package) | variables,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_changing_a_helper_recompiles_the_kernels_that_inline_it(compiled):
    assert run(compiled) == "0.693 loaded"
    helper = compiled / "kernels/symmetric3.py"
    formula = "math.log(determinant(s))"
    assert formula in helper.read_text()
    helper.write_text(helper.read_text().replace(formula, formula.replace("log", "exp")))
    assert [run(compiled), run(compiled)] == ["7.389 compiled", "7.389 loaded"]


def test_a_read_only_cache_is_still_read(package):
    assert run(package, "locked") == "0.693 compiled"
    assert run(package) == "0.693 compiled"
    assert run(package, "locked") == "0.693 loaded"


def test_a_run_whose_kernels_cannot_be_saved_says_what_to_do(package, tmp_path):
    nanogs.save(random_splats(200), tmp_path / "a.ply")
    script = LOCK + "from nanogs.cli import main; main()"
    folder = tmp_path / "nowhere"
    result = subprocess.run(
        [sys.executable, "-c", script, "convert", "a.ply", "b.sog"],  # one kernel
        env=environment(package) | {"NUMBA_CACHE_DIR": str(folder)},
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    [note] = [line for line in result.stderr.splitlines() if "NUMBA_CACHE_DIR" in line]
    assert note.startswith(f"note: Compiled kernels cannot be saved in {folder}")
    library = subprocess.run(
        [sys.executable, "-c", LOGARITHM, "locked"],
        env=environment(package), capture_output=True, text=True, check=True,
    ).stderr  # fmt: skip
    assert library.count("set NUMBA_CACHE_DIR") == 1
    assert library.count("are being compiled for this processor") == 1
    assert "on the disk" not in library


def test_later_runs_find_what_can_be_saved(package):
    library = subprocess.run(
        [sys.executable, "-c", LOGARITHM],
        env=environment(package), capture_output=True, text=True, check=True,
    ).stderr  # fmt: skip
    assert "later runs find them on the disk" in library


def test_a_read_only_cache_in_a_given_folder_is_still_read(package, tmp_path):
    folder = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert run(package, **folder) == "0.693 compiled"
    assert run(package, "locked", **folder) == "0.693 loaded"


def test_kernels_with_bounds_checks_are_cached_separately(compiled):
    checked = {"NUMBA_BOUNDSCHECK": "1"}
    assert run(compiled, **checked) == "0.693 compiled"
    assert [run(compiled), run(compiled, **checked)] == ["0.693 loaded"] * 2


COUNTED = """
import numpy as np
from numba.core import event

from nanogs.kernels.forest import log_determinants

with event.install_recorder("numba:compile") as compiled:
    log_determinants(np.array([[2.0, 0, 0, 1, 0, 1]]), np.empty(1))
print(len(compiled.buffer))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no process waits for another's kernels there")
def test_processes_that_start_together_compile_each_kernel_once(package):
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", COUNTED],
            env=environment(package),
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(3)
    ]
    compiled = sorted(int(child.communicate(timeout=100)[0]) for child in processes)
    assert compiled[:2] == [0, 0]
    assert compiled[2] > 0


def test_a_callback_is_called_once_if_two_threads_begin_to_compile_at_once(monkeypatch):
    class Waiting(list):
        """Callbacks that another thread takes just after this one has seen that there are some."""

        def __bool__(self):
            found = list.__len__(self) > 0
            if found and not others:
                others.append(Thread(target=compiling.begin))
                others[0].start()
                others[0].join()
            return found

    told, others = [], []
    monkeypatch.setattr(compiling, "_waiting", Waiting())
    with compiling.watching(lambda _begun: None):
        compiling.when_compiling(lambda: told.append(1))
        for _ in range(2):
            compiling.begin()
        for _ in range(2 + len(others)):
            compiling.end()
    assert told == [1]
