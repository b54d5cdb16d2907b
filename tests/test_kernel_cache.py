"""Kernels on disk: what changes any source of theirs makes all of them anew."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import nanogs

MERGE = """
import sys

import numpy as np

if "locked" in sys.argv:
    from numba.core import caching

    def refuse(*_):
        raise PermissionError("read-only")

    caching._CacheLocator.ensure_cache_path = refuse
    caching.IndexDataCacheFile._open_for_write = refuse

from nanogs.kernels.compiling import when_compiling
from nanogs.kernels.merge import merge_pairs

told = []
when_compiling(lambda: told.append(1))
scales, quats = np.ones((2, 3), np.float32), np.tile(np.float32([1, 0, 0, 0]), (2, 1))
merged = np.empty((1, 3), np.float32)
merge_pairs(
    np.array([[0, 1]], np.int32), np.zeros(1, np.int64), np.zeros(2),
    np.array([[0.0, 0, 0], [2, 0, 0]]), scales, quats, np.full(2, 0.5),
    np.empty((1, 3)), merged, np.empty((1, 4), np.float32), np.empty(1), np.empty((1, 2)),
)
print(round(float(merged[0, 0]), 3), "compiled" if told else "loaded")
"""


@pytest.fixture
def package(tmp_path):
    """A copy of the package, whose kernels may be changed."""
    ignored = shutil.ignore_patterns("__pycache__", "viewer.js")
    shutil.copytree(Path(nanogs.__file__).parent, tmp_path / "nanogs", ignore=ignored)
    return tmp_path / "nanogs"


def run(package, *arguments, **variables):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    result = subprocess.run(
        [sys.executable, "-c", MERGE, *arguments],
        env=environment | {"PYTHONPATH": str(package.parent)} | variables,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_a_changed_helper_changes_the_kernels_that_inline_it(package):
    assert [run(package), run(package)] == ["1.414 compiled", "1.414 loaded"]
    helper = package / "kernels/symmetric3.py"
    right = "p * s[0] + q * t[0] + pq * x * x"
    assert right in helper.read_text()
    helper.write_text(helper.read_text().replace(right, f"100 * ({right})"))
    assert [run(package), run(package)] == ["14.142 compiled", "14.142 loaded"]


def test_a_cache_that_cannot_be_written_is_read(package):
    assert run(package, "locked") == "1.414 compiled"
    assert run(package) == "1.414 compiled"
    assert run(package, "locked") == "1.414 loaded"


def test_a_named_cache_that_cannot_be_written_is_read(package, tmp_path):
    named = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert run(package, **named) == "1.414 compiled"
    assert run(package, "locked", **named) == "1.414 loaded"


def test_kernels_with_checks_of_bounds_are_kept_apart(package):
    checked = {"NUMBA_BOUNDSCHECK": "1"}
    assert [run(package), run(package, **checked)] == ["1.414 compiled"] * 2
    assert [run(package), run(package, **checked)] == ["1.414 loaded"] * 2
