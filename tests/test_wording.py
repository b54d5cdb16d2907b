"""Wording of messages and docstrings: singular and plural, units, and names that exist."""

import ast
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import nanogs
from nanogs.findings import Finding, Names, join_findings, negative_scales, of_plain, to_plain
from nanogs.formatting import (
    NONE,
    bytes_text,
    counted,
    listed,
    plain,
    sizes_text,
    time_text,
    undrawn,
    utf8,
)
from nanogs.report import StopReason

SOURCES = sorted(Path(nanogs.__file__).parent.rglob("*.py"))
TESTS = sorted(Path(__file__).parent.glob("*.py"))
BENCHMARKS = sorted((Path(__file__).parents[1] / "benchmarks").glob("*.py"))
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
WHAT = re.compile(r"What(ever)?\b")
# Dotted names in backticks, but for those of files and of other packages.
DOTTED = re.compile(r"`((?:[A-Za-z_]\w*\.)+[A-Za-z_]\w*)`")
FILES = {"bin", "json", "lcc", "ply", "py", "rad", "txt"}
FOREIGN = {"Client", "Transforms", "concurrent", "dataclasses", "json", "np", "numpy", "time"}
FOREIGN |= {"torch", "typer"}
NAME = re.compile(r"`([A-Za-z_]\w*)`")
MODULE = re.compile(r"`([\w/]+\.py)`")
SECTION = re.compile(r"^(Args|Attributes):\n((?: {4}.*\n?|\n)+)", re.MULTILINE)
ENTRY = re.compile(r"^ {4}\**(\w+):", re.MULTILINE)
# Names of formats, viewers and languages, and of views, which no code here has.
THEIRS = {"Host", "NGSP", "RAD0", "RADC", "Xform", "f_dc", "finally", "fit_000", "fit_roam_000"}
THEIRS |= {"fl_x", "fru", "envscale", "envshcoef", "ninf", "nnan", "scalesh", "lodInflate"}
THEIRS |= {"lodBaseDistance", "lodBehindPenalty", "lodDistanceShrink", "lodMultiplier"}
THEIRS |= {"lodRenderScale", "maximumScreenSpaceError"}
# A number before a fixed plural, which is wrong if the number is 1.
PLURAL = re.compile(
    r"\{[^{}]*\}\s+(splats|bytes|views|rows|photographs)\s+(with|have|has|are|were|is)\b"
)

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 splats"), (1, "1 splat"), (2, "2 splats"), (1500, "1,500 splats")]
)
def test_counted_uses_singular_and_plural(count, text):
    assert counted(count, "splat") == text


def test_words_after_a_number_agree_with_it():
    assert counted(1, "opacity is", "opacities are") == "1 opacity is"
    assert counted(3, "opacity is", "opacities are") == "3 opacities are"
    assert undrawn(1) == "1 splat with a NaN or infinite value was not drawn"
    assert undrawn(2) == "2 splats with a NaN or infinite value were not drawn"


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (None, NONE), (0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (999_949, "999.9 kB"),
        (999_950, "1.0 MB"), (1_500_000, "1.5 MB"), (76_040_000, "76.0 MB"),
        (999_949_999, "999.9 MB"), (999_950_000, "1.0 GB"), (12_345_000_000_000, "12345.0 GB"),
    ],
)  # fmt: skip
def test_bytes_have_the_unit_that_fits(count, text):
    assert bytes_text(count) == text


def test_two_sizes_share_a_unit_if_it_is_the_same():
    assert sizes_text(76_000_000, 1_200_000, "→") == "76.0 → 1.2 MB"
    assert sizes_text(1_200_000, 76_000, "to") == "1.2 MB to 76.0 kB"
    assert sizes_text(76_000, 76, "→") == "76.0 kB → 76 B"  # both units end in B
    assert sizes_text(None, 76, "→") == f"{NONE} → 76 B"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0.0 s"), (0.44, "0.4 s"), (0.94, "0.9 s"), (0.95, "1 s"), (6.4, "6 s"),
        (89.4, "89 s"), (90, "2 min"), (720, "12 min"), (5340, "89 min"), (5400, "1.5 h"),
        (36_000, "10.0 h"),
    ],
)  # fmt: skip
def test_durations_are_rounded(seconds, text):
    assert time_text(seconds) == text


def test_values_that_json_lacks_become_text():
    inner = {"psnr": math.inf, "path": Path("a", "b"), "stop": StopReason.TARGET, "none": None}
    data = plain({"models": (inner, [math.nan, -math.inf, 1.5, 2, True])})
    assert data["models"] == [
        {"psnr": "inf", "path": str(Path("a", "b")), "stop": "target", "none": None},
        ["nan", "-inf", 1.5, 2, True],
    ]
    assert type(data["models"][0]["stop"]) is str


def test_any_file_name_can_be_encoded_as_utf8():
    """Python represents bytes of file names that are not UTF-8 as lone surrogates."""
    assert utf8("é\udcff☃") == b"\xc3\xa9\\udcff\xe2\x98\x83"


def test_findings_of_blocks_add_up_to_one_sentence():
    [one], [two] = negative_scales(1), negative_scales(1200)
    assert one == "1 splat has a negative scale, which became NaN."
    assert join_findings([[one], [two]]) == (
        "1,201 splats have a negative scale, which became NaN.",
    )
    assert of_plain(to_plain(one)) == one
    rounded = [of_plain(to_plain(Finding("To 1/{}.", value, min))) for value in (512, 256)]
    assert join_findings([rounded]) == ("To 1/256.",)
    named = [of_plain(to_plain(Finding("{}", Names(n), Names.union))) for n in ("ab", "bc")]
    assert join_findings([named]) == ("a, b, c",)
    assert Finding("Rounded to 1/{}.", 2048, min) == "Rounded to 1/2048."


def test_the_library_speaks_of_arguments_and_the_command_of_options():
    """Python users read the library's sentences too; `cli.wording` puts options into them."""
    folder = Path(nanogs.__file__).parent
    found = set()
    for path in SOURCES:
        if path.is_relative_to(folder / "cli"):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = {
            id(node.body[0].value)
            for node in ast.walk(tree)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            and isinstance(node.body[0], ast.Expr)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                text = node.value if id(node) not in docstrings else ""
                found |= {f"{path.name}: {option}" for option in OPTION.findall(text)}
    assert found == set()


def test_no_message_has_a_fixed_plural_after_a_number():
    found = {path.name: PLURAL.findall(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert len(found) > 200
    always_many = {"sink.py"}  # "... splats are too many"
    assert {name for name, each in found.items() if each} == always_many


def test_no_docstring_begins_with_what():
    """A docstring begins with the thing itself, or with what is done; "what" only points at it."""
    found = set()
    for path in [*SOURCES, *TESTS, *BENCHMARKS]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, DOCUMENTED) and WHAT.match(ast.get_docstring(node) or ""):
                found.add(f"{path.name}: {getattr(node, 'name', 'the module')}")
    assert found == set()


def members(body: list[ast.stmt]) -> Iterator[tuple[str, list[ast.stmt]]]:
    """Yield each name that is defined or imported in a module or a class, and its own body."""
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name, node.body if isinstance(node, ast.ClassDef) else []
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from ((each.asname or each.name, []) for each in node.names)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [each for target in targets for each in ast.walk(target)]
            yield from ((each.id, []) for each in names if isinstance(each, ast.Name))


def known_names() -> set[str]:
    """Return modules, their definitions and members of classes, by all their trailing parts."""
    found = {f"nanogs.{name}" for name in nanogs.__all__}
    for path in SOURCES:
        parts = path.relative_to(SOURCES[0].parents[1]).with_suffix("").parts
        module = ".".join(parts).removesuffix(".__init__")
        found.add(module)
        for name, body in members(ast.parse(path.read_text(encoding="utf-8")).body):
            found.add(f"{module}.{name}")
            found |= {f"{module}.{name}.{inner}" for inner, _ in members(body)}
    return {".".join(name.split(".")[first:]) for name in found for first in range(name.count("."))}


def test_dotted_names_in_docstrings_and_comments_exist():
    """Texts that still name something that was moved or renamed are found."""
    known, stale = known_names(), set()
    for path in SOURCES:
        for name in DOTTED.findall(path.read_text(encoding="utf-8")):
            ours = name.split(".")[0] not in FOREIGN and name.split(".")[-1] not in FILES
            if ours and name not in known:
                stale.add(f"{path.name}: {name}")
    assert stale == set()


def identifiers(tree: ast.AST) -> Iterator[str]:
    """Yield the names in a piece of code, and the words of its short strings."""
    for node in ast.walk(tree):
        match node:
            case ast.Name():
                yield node.id
            case ast.Attribute():
                yield node.attr
            case ast.arg() | ast.keyword():
                yield node.arg or ""
            case ast.ClassDef() | ast.FunctionDef():
                yield node.name
            case ast.alias():
                yield from node.name.split(".")
            case ast.Constant(value=str() as text) if len(text) < 40:
                yield from re.findall(r"\w+", text)


def test_single_names_in_docstrings_and_comments_exist():
    """A name that no code has any more is found, wherever it was defined."""
    known = THEIRS | {path.stem for path in SOURCES} | {path.parent.name for path in SOURCES}
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCES}
    for text in texts.values():
        known |= set(identifiers(ast.parse(text)))
    stale = {f"{p.name}: {name}" for p, text in texts.items() for name in NAME.findall(text)}
    assert {name for name in stale if name.partition(": ")[2] not in known} == set()


def test_modules_in_docstrings_and_comments_exist():
    """A path is that of a module beside this one, or begins at the package or the repository."""
    package = Path(nanogs.__file__).parent
    stale = set()
    for path in SOURCES:
        for name in MODULE.findall(path.read_text(encoding="utf-8")):
            folders = path.parent, package, package.parents[1]
            if not any((folder / name).is_file() for folder in folders):
                stale.add(f"{path.name}: {name}")
    assert stale == set()


def test_sections_of_docstrings_name_what_is_there():
    """`Args` names only parameters, and `Attributes` only what the class has."""
    wrong = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ClassDef | ast.FunctionDef):
                continue
            for kind, text in SECTION.findall(ast.get_docstring(node) or ""):
                names, known = ENTRY.findall(text), list(identifiers(node))
                if kind == "Args" and isinstance(node, ast.FunctionDef):
                    signature = ast.walk(node.args)
                    known = [each.arg for each in signature if isinstance(each, ast.arg)]
                if not set(names) <= set(known):
                    wrong.add(f"{path.name}: {node.name}")
    assert wrong == set()


def test_the_map_of_the_modules_names_files_that_exist():
    """The first column of the map in CONTRIBUTING.md."""
    root = Path(__file__).parents[1]
    text = (root / "CONTRIBUTING.md").read_text(encoding="utf-8")
    listed = re.findall(r"^  (\w+(?:\.py|/))", text, re.MULTILINE)
    assert len(listed) > 20
    assert [name for name in listed if not (root / "src/nanogs" / name).exists()] == []


def test_lists_have_commas_and_a_word_before_the_last_item():
    assert listed([2], "or") == "2"
    assert listed(iter(("a", "b")), "and") == "a and b"
    assert listed((2, 3, 4), "or") == "2, 3 or 4"
