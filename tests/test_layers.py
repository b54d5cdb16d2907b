"""Which part of the package may import which: from the ground floor up, and never in a circle."""

import ast
import importlib
from collections.abc import Iterator
from functools import cache, reduce
from pathlib import Path
from typing import NamedTuple

import pytest

import nanogs

ROOT = Path(nanogs.__file__).parent

# From the bottom up, and in a line from left to right: each may import what is before it. A folder
# stands for all modules in it.
ORDER = """
_version _types errors ranges formatting findings quantities defaults activations place protocol sh
charts costs switches progress clock cleanup allocation threads slices parallel sorting morton
kernels
card
bar neighbours percentiles
_arrays splats frames gsplat_arrays metrics
filters source
raster
io
memory memory_estimates
datasets views
fit
report
block_layouts
sink method
summary
view scoring
store lod
pipeline environments levels_of_detail model_info conversion
ahead warming
studio
bench cli __main__
""".split()

# Imports that go up, each when something is called and not before; why.
UP = {
    ("splats", "gsplat_arrays"): "`from_gsplat` and `to_gsplat` are methods; what they do is apart",
    ("splats", "summary"): "a notebook shows a model, with its picture, through `_repr_html_`",
    ("io.html", "view"): "a page in which a model moves is a format to write",
    ("io.html", "views"): "and it opens on a view that is found from the model",
}

# What a part may import of ours, where that is less than all below it.
ALONE = {
    "kernels": {"_types", "errors", "slices", "parallel"},
    "card": {"_types", "errors", "kernels"},
    "raster": {
        "_types",
        "card",
        "errors",
        "formatting",
        "kernels",
        "slices",
        "splats",
        "parallel",
        "activations",
    },
    "metrics": {"_types", "errors", "kernels"},
}

# What a part may not import, although it is below: modules of ours and of others.
NOT = {
    "method": {"nanogs.io", "nanogs.clock", "nanogs.progress", "nanogs.memory", "pathlib", "time"},
    "kernels": {"pathlib", "time"},
    # Sinks are handed in: `levels_of_detail` puts the two together.
    "lod": {"nanogs.pipeline", "nanogs.store"},
    "pipeline": {"nanogs.lod"},
    "cli": {"numpy", "numba", "nanogs.raster", "nanogs.metrics", "nanogs.store"},  # it only asks
}
# Where that does not hold yet, or need not.
STILL = {
    ("method.forest", "nanogs.progress"): "passes are told of one by one",
    ("method.visibility", "nanogs.progress"): "views are told of one by one",
    ("method.paper.passes", "nanogs.progress"): "passes are told of one by one",
    ("method.forest", "nanogs.clock"): "the report has the seconds of each pass",
    ("method.paper.passes", "nanogs.clock"): "the report has the seconds of each pass",
    ("kernels.cached", "pathlib"): "finds the compiled kernels on the disk",
}


class Import(NamedTuple):
    """One import: by which module of ours, of what, and when it is done."""

    module: str
    imported: str  # the whole name, of ours or of others
    when: str  # "first" with the module, "later" in a function, "typing" for annotations alone


def name_of(path: Path) -> str:
    """A module's name without the package's, such as `io.splat`, and `io` for `io/__init__.py`."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def all_imports() -> tuple[Import, ...]:
    paths = sorted(ROOT.rglob("*.py"))
    known = {name_of(path) for path in paths}
    return tuple(one for path in paths for one in imports_of(path, known))


def imports_of(path: Path, known: set[str]) -> Iterator[Import]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typing = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in ast.walk(block)
    }
    first = {id(node) for node in tree.body}
    for node in ast.walk(tree):
        when = "typing" if id(node) in typing else "first" if id(node) in first else "later"
        for target in targets(node):
            ours = target.startswith("nanogs.")
            inside = ours and target.removeprefix("nanogs.") not in known  # a name in a module
            yield Import(name_of(path), target.rpartition(".")[0] if inside else target, when)


def targets(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    if isinstance(node, ast.ImportFrom):
        assert not node.level, "imports say the whole name"
        ours = node.module.split(".")[0] == "nanogs"
        yield from (f"{node.module}.{one.name}" if ours else node.module for one in node.names)


def part_of(name: str) -> str:
    """The package or module right below ours that a name of ours begins with."""
    return name.removeprefix("nanogs.").partition(".")[0]


def between_parts() -> list[Import]:
    """Imports of one part by another; but for those of `__init__.py`, which only names them."""
    return [
        one
        for one in all_imports()
        if one.imported.startswith("nanogs.")
        and one.module != "__init__"
        and part_of(one.module) != part_of(one.imported)
    ]


def test_every_part_has_its_place():
    parts = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert sorted(ORDER) == sorted(parts - {"__init__", "__pycache__", "nanogs", "py"})


def test_imports_go_down():
    """So that there is no circle of packages, and each can be read without those above it."""
    up = {
        (one.module, part_of(one.imported), one.when)
        for one in between_parts()
        if ORDER.index(part_of(one.module)) < ORDER.index(part_of(one.imported))
    }
    assert {(module, part) for module, part, _ in up} == set(UP)
    assert all(when == "later" for *_, when in up)


@pytest.mark.parametrize("part", ALONE)
def test_parts_that_stand_alone_import_little(part):
    used = {part_of(one.imported) for one in between_parts() if part_of(one.module) == part}
    assert used <= ALONE[part]


@pytest.mark.parametrize("part", NOT)
def test_parts_leave_to_others_what_is_theirs(part):
    used = {
        (one.module, forbidden)
        for one in all_imports()
        for forbidden in NOT[part]
        if part_of(one.module) == part and f"{one.imported}.".startswith(f"{forbidden}.")
    }
    assert used == {key for key in STILL if part_of(key[0]) == part}


def test_modules_import_each_other_in_no_circle():
    needs: dict[str, set[str]] = {}
    for one in all_imports():
        imported = one.imported.removeprefix("nanogs.")
        if one.when == "first" and imported not in (one.imported, one.module):
            needs.setdefault(one.module, set()).add(imported)
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " imports ".join((*path[path.index(module) :], module))
        if module not in done:
            for further in sorted(needs.get(module, ())):
                visit(further, (*path, module))
            done.add(module)

    for module in sorted(needs):
        visit(module, ())


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=name_of)
def test_no_module_is_hidden_by_another_thing_of_its_name(path):
    """`nanogs.io.spz.write` is the module, whatever functions its package imports."""
    name = f"nanogs.{name_of(path)}".removesuffix(".__init__")
    if name.endswith("__main__"):
        return
    if part_of(name.removeprefix("nanogs.")) == "card":
        pytest.importorskip("warp", reason="pip install 'nanogs[cuda]'")
    module = importlib.import_module(name)
    assert reduce(getattr, name.split(".")[1:], nanogs) is module
