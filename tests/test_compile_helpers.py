"""The helper processes of a first run: they compile the kernels that the run needs last."""

import subprocess
import sys

import pytest

from nanogs import ahead
from nanogs.kernels import needed


@pytest.fixture(autouse=True)
def uncached():
    ahead.compile_ahead.cache_clear()
    yield
    ahead.compile_ahead.cache_clear()


@pytest.mark.parametrize(("processors", "helpers"), [(1, 0), (2, 1), (16, 3)])
def test_helpers_are_started_once_and_for_spare_processors_only(monkeypatch, processors, helpers):
    started, stopped = [], []

    class Process:
        def kill(self):
            raise AssertionError("at the end only")

    def popen(command, **_options):
        started.append(command)
        return Process()

    monkeypatch.setattr(ahead.subprocess, "Popen", popen)
    monkeypatch.setattr(ahead.atexit, "register", stopped.append)
    monkeypatch.setattr(ahead, "processors", lambda: processors)
    for _ in range(2):
        ahead.compile_ahead("fast")
    assert len(started) == len(stopped) == helpers
    assert all(command[1:] == ["-m", "nanogs.ahead", "fast"] for command in started)


def test_helpers_compile_from_the_last_kernel_and_skip_failures(monkeypatch):
    compiled = []

    class FakeKernel:
        def __init__(self, name):
            self.name = name

        def compile(self, *, wait):
            compiled.append((self.name, wait))
            if self.name == "second":
                raise TypeError("of a kernel that was changed")

    monkeypatch.setattr(
        needed,
        "needed",
        lambda preset: [FakeKernel("first"), FakeKernel("second"), FakeKernel(preset)],
    )
    ahead.compile_from_the_end("fast")
    assert compiled == [("fast", False), ("second", False), ("first", False)]


def test_an_empty_kernel_cache_is_detected_without_importing_numba(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert ahead.nothing_compiled()
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert not ahead.nothing_compiled()
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    (tmp_path / "kernels_1").mkdir()
    (tmp_path / "kernels_1" / "one.nbi").touch()
    assert not ahead.nothing_compiled()
    code = "import sys, nanogs.ahead as a; a.nothing_compiled(); print('numba' in sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "False"


HOLD = """
import sys
from nanogs.kernels.forest import log_determinants

with log_determinants._compiled._cache.alone():
    print(flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no process knows what others compile there")
def test_a_kernel_that_another_process_compiles_is_skipped(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    program = (
        "from nanogs.kernels.needed import needed\n"
        "[one] = [one for one in needed() if one.name == 'forest.log_determinants']\n"
        "print(one.held(), one.compile(wait=False), one.held())"
    )

    def held_compiled_held():
        command = [sys.executable, "-c", program]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with holder:
        holder.stdout.readline()
        assert held_compiled_held() == ["False", "False", "False"]
        holder.communicate("")
    assert held_compiled_held() == ["False", "True", "True"]
    assert held_compiled_held() == ["True", "False", "True"]
