"""`nanogs warm`, and the table of the kernels that it and first runs compile."""

import importlib
import inspect
import json
import os
import pkgutil
import subprocess
import sys

import pytest
from numba.core import sigutils

import nanogs.kernels
from kernel_copies import copy_kernels
from nanogs import warming
from nanogs.errors import NanogsError, OptionError
from nanogs.kernels.cached import _Cache
from nanogs.kernels.needed import needed
from nanogs.parallel import ParallelKernel

REMEDY = "run `python benchmarks/signatures.py`"
# Kernels that few runs need, and that are compiled only then.
RARELY_NEEDED = {
    "listing.extent_of",  # pictures of models that are not held in memory
    "listing.cut_boxes",
    "pairs.tally_free",  # a matching of a million splats, most of which are left after some rounds
}


def every_kernel():
    """Yield name and Python function of each kernel, without inlined functions."""
    for module in pkgutil.walk_packages(nanogs.kernels.__path__, "nanogs.kernels."):
        for name, value in vars(importlib.import_module(module.name)).items():
            kernel = value._compiled if isinstance(value, ParallelKernel) else value
            kept = isinstance(getattr(kernel, "_cache", None), _Cache)
            if kept and kernel.py_func.__module__ == module.name:
                yield f"{module.name.removeprefix('nanogs.kernels.')}.{name}", kernel.py_func


compiled_only = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT", "0") != "0", reason="nothing is compiled"
)


@compiled_only
def test_the_table_names_every_kernel_and_the_arguments_that_it_takes():
    functions = dict(every_kernel())
    assert set(functions) - {one.name for one in needed()} == RARELY_NEEDED, REMEDY
    for one in needed():
        types, _ = sigutils.normalize_signature(one.types)
        assert len(types) == len(inspect.signature(functions[one.name]).parameters), REMEDY


@compiled_only
def test_presets_need_a_part_of_the_table():
    fast, default, paper, every = map(needed, ("fast", "default", "paper", None))
    assert set(fast) | set(default) | set(paper) < set(every)
    assert "advance.advance_splats" in {one.name for one in default} - {one.name for one in fast}
    assert set(paper) - set(default)


RUNS = """
import sys
from numba.core import event
from nanogs.cli import main

class CompileListener(event.Listener):
    def on_start(self, started):
        print("compiled", started.data["dispatcher"])
    def on_end(self, ended):
        pass

event.register("numba:compile", CompileListener())
sys.argv = ["nanogs", *sys.argv[1:]]
main()
"""


@compiled_only
@pytest.mark.slow
def test_after_warm_no_preset_compiles_anything(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def run(*arguments, **further):
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=tmp_path, env=environment | further, capture_output=True, text=True, check=True,
        )  # fmt: skip

    run("-m", "nanogs", "warm", NUMBA_CACHE_DIR=os.environ.get("NUMBA_CACHE_DIR", ""))
    gone = copy_kernels(tmp_path / "cache", ("radix.", "assign.", "nodes.principal_axes"))
    first = run("-m", "nanogs", "warm", "--json")
    again = run("-m", "nanogs", "warm")
    report = json.loads(first.stdout)
    assert first.stderr == ""
    assert report["compiled"] == len(gone) > 3
    assert report["kernels"] == len(needed())
    assert all(folder.startswith(str(tmp_path)) for folder in report["folders"])
    assert f"{report['kernels']} kernels for {report['processor']}" in again.stderr
    assert "all compiled already" in again.stderr
    run("-m", "nanogs", "demo", "scene.ply", "--count", "2000")
    small = ("--steps", "2", "--views", "2", "--view-size", "64")
    for further in (("fast",), ("default", *small), ("paper",)):
        words = ("scene.ply", "small.ply", "-w", "--ratio", "0.1", "--preset", *further)
        assert run("-c", RUNS, "simplify", *words).stdout == "", REMEDY
    assert run("-c", RUNS, "convert", "scene.ply", "scene.sog").stdout == "", REMEDY


def test_warm_refuses_to_run_with_compilation_disabled():
    result = subprocess.run(
        [sys.executable, "-m", "nanogs", "warm"],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "unset it" in result.stderr


@compiled_only
@pytest.mark.parametrize("workers", [0, 1.5, "2", True])
def test_the_number_of_processes_must_be_a_whole_number(workers):
    words = f"workers must be a whole number, 1 or more, not {workers!r}"
    with pytest.raises(OptionError, match=words):
        warming.warm(workers=workers)


def test_an_unwritable_cache_folder_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(NanogsError, match="NUMBA_CACHE_DIR"):
        warming._check_writable(tmp_path / "file" / "kernels")
    warming._check_writable(tmp_path / "new" / "kernels")
    assert not list((tmp_path / "new" / "kernels").iterdir())
