"""Which part of the package may import which: only parts below it, and never in a cycle."""

import ast
import importlib
from collections.abc import Iterator
from functools import cache, reduce
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import pytest

import nanogs

ROOT = Path(nanogs.__file__).parent

# From the bottom up, and in a line from left to right: each may import those before it. A folder
# means all modules in it.
ORDER = """
_version _types errors paths ranges formatting findings quantities defaults activations place
protocol sh control_groups templates
charts costs switches progress clock cleanup allocation threads slices parallel sorting morton
kernels
card
bar neighbours percentiles averages
_arrays splats pose frames gsplat_arrays column_statistics metrics
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

# Imports of parts above, each inside a function only, with the reason.
UPWARD = {
    ("splats", "gsplat_arrays"): "`from_gsplat` and `to_gsplat` are methods; what they do is apart",
    ("splats", "summary"): "a notebook shows a model, with its picture, through `_repr_html_`",
    ("io.html", "view"): "a page in which a model moves is a format to write",
    ("io.html", "views"): "and it opens on a view that is found from the model",
}

# The parts of nanogs that a part may import, if these are fewer than all below it.
ALLOWED = {
    "kernels": {"_types", "errors", "slices", "parallel"},
    "card": {"_types", "errors", "kernels"},
    "raster": {
        "_arrays",
        "_types",
        "card",
        "errors",
        "formatting",
        "kernels",
        "slices",
        "splats",
        "parallel",
        "ranges",
    },
    "metrics": {"_types", "errors", "kernels"},
}

# Modules, of nanogs and of others, that a part may not import although they are below it.
FORBIDDEN = {
    "method": {"nanogs.io", "nanogs.clock", "nanogs.progress", "nanogs.memory", "pathlib", "time"},
    "kernels": {"pathlib", "time"},
    # Sinks are passed in: `levels_of_detail` connects the two.
    "lod": {"nanogs.pipeline", "nanogs.store"},
    "pipeline": {"nanogs.lod"},
    # The commands only call the library.
    "cli": {"numpy", "numba", "nanogs.raster", "nanogs.metrics", "nanogs.store"},
}
# Exceptions to this, some of them for good.
EXCEPTIONS = {
    ("method.forest", "nanogs.progress"): "passes are told of one by one",
    ("method.paper.passes", "nanogs.progress"): "passes are told of one by one",
    ("method.forest", "nanogs.clock"): "the report has the seconds of each pass",
    ("method.paper.passes", "nanogs.clock"): "the report has the seconds of each pass",
    ("kernels.cached", "pathlib"): "finds the compiled kernels on the disk",
}


class Import(NamedTuple):
    """An import: the module of nanogs that does it, the module imported, and when."""

    module: str
    imported: str  # the full name, of nanogs or of others
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
    """Return the package or module directly below `nanogs` that a module belongs to."""
    return name.removeprefix("nanogs.").partition(".")[0]


def between_parts() -> list[Import]:
    """Return the imports of one part by another, except those of `__init__.py`, which exports."""
    return [
        one
        for one in all_imports()
        if one.imported.startswith("nanogs.")
        and one.module != "__init__"
        and part_of(one.module) != part_of(one.imported)
    ]


def test_every_part_is_in_the_order():
    parts = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert sorted(ORDER) == sorted(parts - {"__init__", "__pycache__", "nanogs", "py"})


def test_parts_import_only_parts_below_them():
    """So there are no cycles of packages, and each can be read without those above it."""
    upward = {
        (one.module, part_of(one.imported), one.when)
        for one in between_parts()
        if ORDER.index(part_of(one.module)) < ORDER.index(part_of(one.imported))
    }
    assert {(module, part) for module, part, _ in upward} == set(UPWARD)
    assert all(when == "later" for *_, when in upward)


@pytest.mark.parametrize("part", ALLOWED)
def test_parts_with_a_list_of_allowed_imports_keep_to_it(part):
    used = {part_of(one.imported) for one in between_parts() if part_of(one.module) == part}
    assert used <= ALLOWED[part]


@pytest.mark.parametrize("part", FORBIDDEN)
def test_parts_do_not_import_modules_forbidden_to_them(part):
    used = {
        (one.module, forbidden)
        for one in all_imports()
        for forbidden in FORBIDDEN[part]
        if part_of(one.module) == part and f"{one.imported}.".startswith(f"{forbidden}.")
    }
    assert used == {key for key in EXCEPTIONS if part_of(key[0]) == part}


def test_modules_do_not_import_each_other_in_a_cycle():
    needs: dict[str, set[str]] = {}
    for one in all_imports():
        imported = one.imported.removeprefix("nanogs.")
        if one.when == "first" and imported not in (one.imported, one.module):
            needs.setdefault(one.module, set()).add(imported)
    visited: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " imports ".join((*path[path.index(module) :], module))
        if module not in visited:
            for further in sorted(needs.get(module, ())):
                visit(further, (*path, module))
            visited.add(module)

    for module in sorted(needs):
        visit(module, ())


@pytest.mark.parametrize("card", [False, True])
def test_no_module_is_hidden_by_something_else_of_its_name(card):
    """`nanogs.io.spz.write` is the module, whatever functions its package imports."""
    if card and not find_spec("warp"):
        pytest.skip("kernels for graphics cards need Warp: pip install 'nanogs[cuda]'")
    found = map(name_of, sorted(ROOT.rglob("*.py")))
    names = [name.removesuffix(".__init__") for name in found if name[:2] != "__"]
    names = [name for name in names if (part_of(name) == "card") == card]
    assert names
    modules = {name: importlib.import_module(f"nanogs.{name}") for name in names}
    seen = {name: reduce(getattr, name.split("."), nanogs) for name in names}
    assert [name for name in names if seen[name] is not modules[name]] == []
