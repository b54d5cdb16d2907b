"""Kernels in vectors and the plain ones: which are taken, and that both do the same."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import nanogs
from nanogs.datasets.synthetic import make_scene
from nanogs.kernels.simd import choice
from nanogs.neighbours import nearest_neighbours

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled"
)


def python(code, **variables):
    """Run code in a process of its own, and return its stdout and stderr."""
    environment = {k: v for k, v in os.environ.items() if k != choice.VARIABLE}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment | variables, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return run.stdout, run.stderr


SIMPLIFY = """
import sys
import nanogs
from nanogs.datasets.synthetic import make_scene
from nanogs.kernels.simd import choice
scene = make_scene(3000, seed=2)
small, _ = nanogs.simplify(scene, count=300, preset="fast")
nanogs.save(small, sys.argv[1] + "/fast.ply", overwrite=True)
if len(sys.argv) > 2:
    small, _ = nanogs.simplify(scene, count=300, steps=0, views=4, view_size=64)
    nanogs.save(small, sys.argv[1] + "/default.ply", overwrite=True)
print(choice.chosen().value, choice.reason())
"""


def simplified(folder, *arguments, first="", **variables):
    folder.mkdir()
    code = f"import sys; sys.argv[1:] = {[str(folder), *arguments]!r}\n{first}\n{SIMPLIFY}"
    said, told = python(code, **variables)
    return said.strip(), told


@pytest.fixture(scope="module")
def in_vectors(tmp_path_factory):
    """A folder with what the vectors give."""
    folder = tmp_path_factory.mktemp("simd") / "simd"
    assert simplified(folder, "default", NANOGS_SIMD="1")[0] == "simd None"
    return folder


@pytest.mark.slow
def test_both_ways_give_the_same(in_vectors, tmp_path):
    said, told = simplified(tmp_path / "plain", "default", NANOGS_SIMD="0")
    assert said == "plain None"
    assert "lower" not in told  # who asks for it knows
    same = [(one / "fast.ply").read_bytes() for one in (in_vectors, tmp_path / "plain")]
    assert same[0] == same[1]
    scene = make_scene(3000, seed=2)
    models = [one / "default.ply" for one in (in_vectors, tmp_path / "plain")]
    one, other = nanogs.compare(scene, *models, views=3, pixels=96).models
    assert one.psnr == pytest.approx(other.psnr, abs=0.05)


def test_pictures_are_the_same_both_ways(tmp_path):
    """To the last bit where operations are fused; elsewhere the ways round apart."""
    code = (
        "import sys, numpy as np, nanogs\n"
        "from nanogs.datasets.synthetic import make_scene\n"
        "np.save(sys.argv[1], nanogs.render(make_scene(2000, seed=3), views=2, pixels=96))\n"
    )
    for way in "01":
        python(f"import sys; sys.argv[1:] = [{str(tmp_path / way)!r}]\n{code}", NANOGS_SIMD=way)
    plain, simd = (np.load(tmp_path / f"{way}.npy") for way in "01")
    assert plain.std() > 0.05
    far = abs(plain - simd) > 1e-5  # where alpha is 1/255 to the last digit
    assert far.mean() < 1e-4


@pytest.mark.slow
def test_plain_functions_compiled_do_as_their_python_says():
    files = [str(ROOT / "tests" / name) for name in ("test_blocks.py", "test_knn.py")]
    files.append(f"{ROOT}/tests/test_refit.py::test_pulls_match_their_twin")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", *files],
        env=os.environ | {"NANOGS_SIMD": "0"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout


UNTRIED = """
from types import SimpleNamespace
from nanogs.kernels.simd import choice
choice.numba = SimpleNamespace(__version__="0.99.0")
"""
BROKEN = """
from numba.core.caching import NullCache
from nanogs.kernels.simd import trial, vectors
trial._call_all._cache = NullCache()  # of what was compiled before
def changed(*_):
    raise NotImplementedError("as in a later version")
vectors.Table.load = vectors.read = changed
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "why"),
    [(UNTRIED, "0.62 to 0.68, and this is 0.99.0"), (BROKEN, "do not compile with Numba")],
    ids=["untried", "broken"],
)
def test_where_the_vectors_cannot_be_trusted_the_plain_way_is_taken_and_said(first, why):
    code = (
        f"{first}\n"
        "import numpy as np\n"
        "from nanogs.kernels.simd import choice\n"
        "from nanogs.neighbours import nearest_neighbours\n"
        "means = np.random.default_rng(0).normal(size=(500, 3))\n"
        "print(choice.chosen().value, choice.reason())\n"
        "print(nearest_neighbours(means, 6, 1).tolist())\n"
    )
    said, told = python(code)
    chosen, found = said.strip().split("\n")
    assert chosen.startswith("plain ")
    assert why in chosen
    assert told.count("Slower kernels are used") == 1
    assert why in told
    assert "NANOGS_SIMD=1 forces the fast ones" in told
    means = np.random.default_rng(0).normal(size=(500, 3))
    assert json.loads(found) == nearest_neighbours(means, 6, 1).tolist()


LOAD = """
import numpy as np
from nanogs.kernels.compiling import when_compiling
from nanogs.kernels.radix import radix_sort
from nanogs.kernels.listing import span_tiles
told = []
when_compiling(lambda: told.append(1))
{call}
print("compiled" if told else "loaded")
"""
SORTS = "radix_sort(np.arange(4, dtype=np.uint64), np.empty(4, np.uint64))"
# Of the kernels that have vectors the one that is compiled soonest.
SPANS = """span_tiles(
    np.empty((0, 8)), np.empty(0, np.int64), np.empty(0, np.int64), 16, 16, np.empty(0, np.uint64),
    np.empty((16, 1), np.int64),
)"""


@pytest.mark.parametrize(("call", "second"), [(SORTS, "loaded"), (SPANS, "compiled")])
def test_kernels_of_each_way_are_kept_apart(tmp_path, call, second):
    """Those that have vectors; of the others there is one way."""
    cache, code = {"NUMBA_CACHE_DIR": str(tmp_path)}, LOAD.format(call=call)
    said = [python(code, NANOGS_SIMD=way, **cache)[0].strip() for way in "1001"]
    assert said == ["compiled", second, "loaded", "loaded"]


def test_who_insists_gets_the_vectors_of_any_version():
    code = f"{UNTRIED}\nprint(choice.chosen().value)"
    assert python(code, NANOGS_SIMD="1") == ("simd\n", "")


def test_a_variable_that_means_nothing_is_refused(tmp_path):
    nanogs.save(make_scene(100), tmp_path / "a.ply")
    run = subprocess.run(
        [sys.executable, "-m", "nanogs", "simplify", "a.ply", "b.ply", "-r", "0.5"],
        env=os.environ | {"NANOGS_SIMD": "yes"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 2
    assert "NANOGS_SIMD must be 0, 1 or not set, not 'yes'" in run.stderr
    assert "Traceback" not in run.stderr
    assert not (tmp_path / "b.ply").exists()


def test_the_versions_that_were_tried_are_those_that_are_installed():
    text = (ROOT / "pyproject.toml").read_text()
    wanted = tomllib.loads(text)["project"]["dependencies"]
    [bounds] = [one for one in wanted if one.startswith("numba")]
    least, above = map(int, re.fullmatch(r"numba>=0\.(\d+),<0\.(\d+)", bounds).groups())
    assert ((0, least), (0, above - 1)) == (choice.FIRST, choice.LAST)
    for version in (f"0.{least}.0", f"0.{above - 1}.9"):
        assert choice._untried(version) is None
    for version in (f"0.{least - 1}.1", f"0.{above}.0rc1", "1.0.0"):
        assert version in choice._untried(version)
