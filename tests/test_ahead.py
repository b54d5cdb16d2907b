"""The second process of a first run: it compiles what the first needs after the look."""

import subprocess
import sys

import pytest

from nanogs import ahead

SIGNATURES = """
import importlib, pkgutil
import nanogs, nanogs.kernels
from nanogs.ahead import compile_later_stages
from nanogs.datasets.synthetic import make_scene

def compiled():
    found = {}
    for module in pkgutil.iter_modules(nanogs.kernels.__path__, "nanogs.kernels."):
        for name, value in vars(importlib.import_module(module.name)).items():
            written = getattr(getattr(value, "_compiled", value), "py_func", None)
            if getattr(written, "__module__", None) == module.name:
                found[module.name, name] = set(map(str, value.signatures))
    return found

compile_later_stages()
ahead = compiled()
nanogs.simplify(make_scene(1000), ratio=0.1, steps=2, views=2, view_size=64)
for (module, name), signatures in compiled().items():
    if signatures - ahead[module, name]:
        print(module.split(".")[-1])
"""


# Compiled last, when rendering has been; the rotations of a step are inlined there.
FITTING = {"advance", "chain", "damped", "backward", "pulls", "quaternion"}


@pytest.mark.slow
def test_what_is_left_to_the_first_process_is_rendering():
    run = subprocess.run(
        [sys.executable, "-c", SIGNATURES], capture_output=True, text=True, check=True
    )
    left = set(run.stdout.split())
    assert "raster" in left
    assert left - FITTING <= {"raster", "listing", "project", "harmonics"}
    fitted = SIGNATURES.replace("compile_later_stages", "compile_fitting")
    run = subprocess.run([sys.executable, "-c", fitted], capture_output=True, text=True, check=True)
    assert not FITTING & set(run.stdout.split())


def test_it_is_started_once_and_only_where_there_is_a_processor_for_it(monkeypatch):
    started, stopped = [], []

    class Process:
        def kill(self):
            raise AssertionError("at the end only")

    def popen(command, **_options):
        started.append(command)
        return Process()

    monkeypatch.setattr(ahead.subprocess, "Popen", popen)
    monkeypatch.setattr(ahead.atexit, "register", stopped.append)
    for processors, times in ((1, 0), (2, 1)):
        monkeypatch.setattr(ahead.os, "cpu_count", lambda count=processors: count)
        ahead.compile_ahead.cache_clear()
        ahead.compile_ahead()
        ahead.compile_ahead()
        assert len(started) == len(stopped) == times
    assert started[0][1:] == ["-m", "nanogs.ahead"]
    ahead.compile_ahead.cache_clear()
