"""SIMD kernels and plain ones: which are chosen, and that both give the same results."""

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
    """Run code in a separate process and return its stdout and stderr."""
    environment = {k: v for k, v in os.environ.items() if k != choice.VARIABLE}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment | variables, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return run.stdout, run.stderr


SIMPLIFY = """
import sys
import numpy as np
import nanogs
from nanogs.datasets.synthetic import make_scene
from nanogs.kernels.simd import choice
scene = make_scene(3000, seed=2)
small, _ = nanogs.simplify(scene, count=300, preset="fast")
nanogs.save(small, sys.argv[1] + "/fast.ply", overwrite=True)
if len(sys.argv) > 2:
    small, _ = nanogs.simplify(scene, count=300, steps=0, views=4, view_size=64)
    nanogs.save(small, sys.argv[1] + "/default.ply", overwrite=True)
    images = nanogs.render(make_scene(2000, seed=3), views=2, pixels=96)
    np.save(sys.argv[1] + "/images.npy", images)
print(choice.chosen().value, choice.reason())
"""


def simplified(folder, *arguments, first="", **variables):
    folder.mkdir()
    code = f"import sys; sys.argv[1:] = {[str(folder), *arguments]!r}\n{first}\n{SIMPLIFY}"
    printed, warned = python(code, **variables)
    return printed.strip(), warned


@pytest.fixture(scope="module")
def simd_results(tmp_path_factory):
    """A folder with models and images by the SIMD kernels."""
    folder = tmp_path_factory.mktemp("simd") / "simd"
    assert simplified(folder, "default", NANOGS_SIMD="1")[0] == "simd None"
    return folder


@pytest.fixture(scope="module")
def plain_results(tmp_path_factory):
    """A folder with the same by the plain kernels."""
    folder = tmp_path_factory.mktemp("simd") / "plain"
    printed, warned = simplified(folder, "default", NANOGS_SIMD="0")
    assert printed == "plain None"
    assert "lower" not in warned  # no warning about plain kernels that were asked for
    return folder


@pytest.mark.slow
def test_simd_and_plain_kernels_give_the_same_result(simd_results, plain_results):
    same = [(one / "fast.ply").read_bytes() for one in (simd_results, plain_results)]
    assert same[0] == same[1]
    scene = make_scene(3000, seed=2)
    models = [one / "default.ply" for one in (simd_results, plain_results)]
    one, other = nanogs.compare(scene, *models, views=3, pixels=96).models
    assert one.psnr == pytest.approx(other.psnr, abs=0.05)


def test_simd_and_plain_kernels_render_nearly_the_same_images(simd_results, plain_results):
    """Bit for bit if both use fused operations; otherwise their rounding differs."""
    plain, simd = (np.load(folder / "images.npy") for folder in (plain_results, simd_results))
    assert plain.std() > 0.05
    far = abs(plain - simd) > 1e-5  # where alpha is at the threshold of 1/255
    assert far.mean() < 1e-4


@pytest.mark.slow
def test_compiled_plain_kernels_match_their_references():
    files = [str(ROOT / "tests" / name) for name in ("test_blocks.py", "test_knn.py")]
    files.append(f"{ROOT}/tests/test_refit.py::test_gradients_match_their_reference")
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
    ("setup", "reason"),
    [(UNTRIED, "0.62 to 0.68, and this is 0.99.0"), (BROKEN, "do not compile with Numba")],
    ids=["untried", "broken"],
)
def test_plain_kernels_are_used_with_a_warning_if_simd_is_untried_or_broken(setup, reason):
    code = (
        f"{setup}\n"
        "import numpy as np\n"
        "from nanogs.kernels.simd import choice\n"
        "from nanogs.neighbours import nearest_neighbours\n"
        "means = np.random.default_rng(0).normal(size=(500, 3))\n"
        "print(choice.chosen().value, choice.reason())\n"
        "print(nearest_neighbours(means, 6).tolist())\n"
    )
    printed, warned = python(code)
    chosen, found = printed.strip().split("\n")
    assert chosen.startswith("plain ")
    assert reason in chosen
    assert warned.count("Slower kernels are used") == 1
    assert reason in warned
    assert "NANOGS_SIMD=1 forces the fast ones" in warned
    means = np.random.default_rng(0).normal(size=(500, 3))
    assert json.loads(found) == nearest_neighbours(means, 6).tolist()


LOAD = """
import numpy as np
from nanogs.kernels.compiling import when_compiling
from nanogs.kernels.radix import radix_sort
from nanogs.kernels.listing import span_tiles
def report(call):
    told = []
    when_compiling(lambda: told.append(1))
    call()
    print("compiled" if told else "loaded")

report(lambda: radix_sort(np.arange(4, dtype=np.uint64), np.empty(4, np.uint64)))
# The kernel with a SIMD version that compiles fastest.
report(lambda: span_tiles(
    np.empty((0, 8)), np.empty(0, np.int64), np.empty(0, np.int64), 16, 16, np.empty(0, np.uint64),
    np.empty((16, 1), np.int64),
))
"""


def test_simd_and_plain_kernels_are_cached_separately(tmp_path):
    """Only kernels that have a SIMD version; the others are cached once."""
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    printed = [python(LOAD, NANOGS_SIMD=switch, **cache)[0].split() for switch in "1001"]
    without_version, with_version = map(list, zip(*printed, strict=True))
    assert without_version == ["compiled", "loaded", "loaded", "loaded"]
    assert with_version == ["compiled", "compiled", "loaded", "loaded"]


def test_simd_can_be_forced_with_any_version_of_numba():
    code = f"{UNTRIED}\nprint(choice.chosen().value)"
    assert python(code, NANOGS_SIMD="1") == ("simd\n", "")


def test_an_invalid_value_of_nanogs_simd_is_refused(tmp_path):
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


def test_tried_numba_versions_are_those_that_pyproject_allows():
    text = (ROOT / "pyproject.toml").read_text()
    expected = tomllib.loads(text)["project"]["dependencies"]
    [bounds] = [one for one in expected if one.startswith("numba")]
    least, above = map(int, re.fullmatch(r"numba>=0\.(\d+),<0\.(\d+)", bounds).groups())
    assert ((0, least), (0, above - 1)) == (choice.FIRST, choice.LAST)
    for version in (f"0.{least}.0", f"0.{above - 1}.9"):
        assert choice._untried(version) is None
    for version in (f"0.{least - 1}.1", f"0.{above}.0rc1", "1.0.0"):
        assert version in choice._untried(version)
