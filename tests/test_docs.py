"""The documentation: its commands work, its links have targets, and the site can be built."""

import importlib
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nanogs
from nanogs.cli import method
from nanogs.cli.file_options import Edits
from nanogs.cli.filtering import parse_filters
from nanogs.datasets.synthetic import make_scene
from nanogs.io import registry
from nanogs.method.parameters import BALANCES
from nanogs.pipeline.options.presets import PRESETS, SUMMARIES

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
NOTEBOOK = ROOT / "examples" / "quickstart.ipynb"

OTHER_PROGRAMS = {  # options of other programs that are named in the text
    "--antialiased", "--app_opt", "--auto-scale-poses", "--center-method", "--export-every",
    "--no-normalize-world-space", "--orientation-method", "--save_ply", "--prefix",
}  # fmt: skip


@pytest.fixture(scope="module")
def hooks():
    """The modules that the build of the site uses."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS / "hooks"))
        import commands
        import formats
        import pages

        yield {"commands": commands, "formats": formats, "pages": pages}


@pytest.fixture(scope="module")
def commands(hooks):
    return hooks["commands"].tree()


def option_names(command):
    return {name for param in command.params for name in (*param.opts, *param.secondary_opts)}


def shown_commands(page):
    """Return the arguments of every `$ nanogs ...` in the console blocks of a page."""
    found = []
    for block in re.findall(r"^```console\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
        lines = block.replace("\\\n", " ").splitlines()
        for line in (line[2:] for line in lines if line.startswith("$ ")):
            lexer = shlex.shlex(line, posix=True, punctuation_chars="|>;&")
            lexer.whitespace_split = True
            words = list(lexer)
            while words:
                end = next((i for i, word in enumerate(words) if word[0] in "|>;&"), len(words))
                if words[:1] == ["nanogs"]:
                    found.append(words[1:end])
                words = words[end + 1 :]
    return found


def check_values(name, values):
    """Check values that the parser leaves to the command: presets, formats, directions, outputs."""
    formats = {known.suffix.lstrip(".") for known in registry.formats()}
    if values.get("preset"):
        assert values["preset"] in PRESETS
    for key in ("out_format", "read_as", "write_as"):
        assert not values.get(key) or str(values[key]).lstrip(".") in formats
    parse_filters(Edits(crop=values.get("crop"), min_opacity=values.get("min_opacity")))
    paths = [Path(path) for path in values.get("paths") or ()]
    if name in ("simplify", "convert") and len(paths) == 2 and paths[1].name != "-":
        registry.writable(paths[1])


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_all_commands_shown_in_the_documentation_can_be_parsed(page, commands):
    for words in shown_commands(page):
        name, *arguments = words
        assert name in commands, words
        context = commands[name].make_context(name, list(arguments))
        check_values(name, context.params)


def test_the_parameter_table_has_the_values_of_the_presets():
    text = (DOCS / "guide" / "simplify.md").read_text()
    [header] = re.findall(r"^\| option \| meaning \|(.*`paper`.*)\|$", text, re.MULTILINE)
    rows = re.findall(r"^\|( `--[a-z-]+` \|[^|\n]+(?:\|[^|\n]*){4})\|$", text, re.MULTILINE)
    names = re.findall(r"`([a-z]+)`", header)
    assert sorted(names) == sorted(PRESETS)
    named = {row.split("|")[0].strip(" `-").replace("-", "_") for row in rows}
    views = {"views", "view_size"}
    assert named == set(method.PARAMETERS) - views, "which have their rows in the table above"
    for row in rows:
        option, _meaning, *cells = (cell.strip() for cell in row.split("|"))
        parameter = option.strip("`-").replace("-", "_")
        for name, cell in zip(names, cells, strict=True):
            value = getattr(PRESETS[name], parameter, None)
            expected = "" if value is None else f"{value:g}"
            if parameter == "balance" and getattr(PRESETS[name], "guided", False):
                expected = " or ".join(f"{balance:g}" for balance in BALANCES)
            assert cell == expected, (option, name)


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial.md", "docs/guide/simplify.md"])
def test_pages_have_the_preset_summaries_of_the_command(page):
    text = (ROOT / page).read_text().replace("`", "")
    for name, summary in SUMMARIES.items():
        assert f"| {name} | {summary}" in text


def test_the_start_page_has_the_figures_of_the_readme():
    rows = [
        re.findall(r"^\| 113,648 splats.*$", page.read_text(), re.MULTILINE)
        for page in (ROOT / "README.md", DOCS / "index.md")
    ]
    assert rows[0] == rows[1] != []


def test_shown_commands_are_found_and_unknown_options_are_errors(commands, tmp_path):
    """Checks that the test of shown commands finds them, since it passes if it finds none."""
    assert sum(len(shown_commands(page)) for page in PAGES) > 60
    page = tmp_path / "page.md"
    page.write_text("```console\n$ cat a.ply | nanogs info a.ply --jsn > b  # why\n```\n")
    assert shown_commands(page) == [["info", "a.ply", "--jsn"]]
    with pytest.raises(Exception, match="--jsn"):
        commands["info"].make_context("info", ["a.ply", "--jsn"])


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_all_options_named_in_the_text_exist(page, commands):
    known = OTHER_PROGRAMS | {"--help", "--install-completion"}
    known = known.union(*map(option_names, commands.values()))
    for code in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", page.read_text()):
        words = code.split()
        if words[0] == "nanogs" and len(words) > 1 and re.fullmatch("[a-z]+", words[1]):
            assert words[1] in commands, code
            assert {word for word in words[2:] if word[0] == "-"} <= option_names(
                commands[words[1]]
            ), code
        elif words[0].startswith("--"):
            assert words[0].partition("=")[0] in known, code


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_between_documents_have_existing_targets(page, hooks):
    assert missing_targets(page.read_text(), page.parent, hooks) == []


def test_links_of_the_changelog_have_targets_in_the_repository_and_on_the_site(hooks):
    text = (ROOT / "CHANGELOG.md").read_text()
    assert missing_targets(text, ROOT, hooks) == []
    assert missing_targets(hooks["pages"].PAGES["changes.md"](), DOCS, hooks) == []


def missing_targets(text, folder, hooks):
    """Return the link targets of a page in `folder` that neither exist nor are generated."""
    generated = {(DOCS / name).resolve() for name in hooks["pages"].MADE}
    targets = re.findall(r"\]\(([^)\s#]+)[^)]*\)", text)
    local = [target for target in targets if not target.startswith(("https://", "mailto:"))]
    paths = [(folder / target).resolve() for target in local]
    return [str(path) for path in paths if not path.exists() and path not in generated]


def test_every_page_is_in_the_navigation(hooks):
    listed = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    existing = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert sorted(listed) == sorted(existing | set(hooks["pages"].PAGES))


def test_every_marker_is_known_and_used(hooks):
    pages = hooks["pages"]
    used = [name for page in PAGES for name in pages.MARKER.findall(page.read_text())]
    assert sorted(used) == sorted(pages.TEXTS)


def test_the_command_reference_lists_all_commands_and_options(hooks, commands):
    text = hooks["commands"].reference()
    for name, command in commands.items():
        assert f"\n## nanogs {name}\n" in text
        for option in option_names(command):
            assert option[0] != "-" or f"`{option}`" in text


def test_help_texts_in_the_command_reference_keep_their_code_and_nothing_else(hooks):
    cell = hooks["commands"]._cell
    assert cell("as `nanogs compare` does, <x>_y_ | *z*") == (
        r"as `nanogs compare` does, &lt;x\>\_y\_ \| \*z\*"
    )
    assert r"\`" not in hooks["commands"].reference()


def test_options_in_code_of_the_site_are_marked_and_nothing_else(hooks):
    """The style sheet keeps marked options in one line."""
    page = hooks["pages"].on_page_content
    marked = '<span class="option">{}</span>'.format
    assert page("<p>a --b <code>nanogs x-y a.ply --ratio 0.1 -w</code> --c</p>") == (
        f"<p>a --b <code>nanogs x-y a.ply {marked('--ratio')} 0.1 {marked('-w')}</code> --c</p>"
    )
    line = '<a id="a -b" href="#x --c"></a><span class="w"> </span>{}<span class="w"> </span>f(-1)'
    code = f"<pre><code>{line}</code></pre>".format
    assert page(code("--sh-degree")) == code(marked("--sh-degree"))


@pytest.mark.parametrize("page", sorted((DOCS / "reference").glob("*.md")), ids=lambda p: p.name)
def test_names_in_the_api_reference_exist(page):
    """`make docs` reads names from the source, and fails on one that is not there."""
    for name in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE):
        owner, _, last = name.rpartition(".")
        if owner and importlib.util.find_spec(owner).submodule_search_locations is None:
            value = getattr(importlib.import_module(owner), last)
            defined_in = getattr(value, "__module__", owner)  # a constant has no `__module__`
            assert defined_in == owner, f"{name} is defined elsewhere"
        elif importlib.util.find_spec(name) is None:
            assert hasattr(importlib.import_module(owner), last), name


def test_the_page_of_formats_lists_all_formats():
    rows = [row for row in (DOCS / "formats.md").read_text().splitlines() if row[:1] == "|"]
    for known in registry.formats():
        assert any(known.suffix in row for row in rows), known.suffix


@pytest.mark.parametrize(
    "file_format",
    [
        file_format
        for file_format in registry.formats()
        if file_format.write and file_format.readable
    ],
    ids=lambda file_format: file_format.suffix,
)
def test_formats_keep_what_the_table_of_formats_says(file_format, hooks, tmp_path):
    """The table is computed from reported losses; this test writes and reads files."""
    plain = replace(make_scene(60, sh_degree=4), comments=())
    kept = hooks["formats"].kept(file_format, plain)
    for number, (name, model) in enumerate(hooks["formats"].variants(plain).items()):
        loaded = written_and_read(model, file_format, tmp_path / str(number))
        found = {
            "columns": np.array_equal(
                loaded.extras.get("label", ()), model.extras.get("label", np.zeros(1))
            ),
            "elements": [element.name for element in loaded.elements] == ["camera"],
            "comments": "made by hand" in loaded.comments,
            "mip": loaded.render_mode == model.render_mode,
            "surfel": loaded.render_mode == model.render_mode,
        }
        assert found[name] == getattr(kept, name), name
    assert written_and_read(plain, file_format, tmp_path / "plain").sh_degree == kept.sh_degree


def written_and_read(splats, known, folder):
    folder.mkdir()
    path = folder / f"a{known.suffix}"
    nanogs.save(splats, path)
    return nanogs.load(path)


# Runs before code that fits models; with the usual steps, fitting would take most of the time.
FEW_STEPS = """
from dataclasses import replace
from nanogs.pipeline.options import presets

few = replace(presets.PRESETS["default"], steps=2, views=4, further=4)
presets.PRESETS = {**presets.PRESETS, "default": few}
"""


def test_the_notebook_runs_and_is_stored_without_outputs(tmp_path):
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5
    for cell in code:
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
    nanogs.save(make_scene(4000), tmp_path / "scene.ply")  # smaller than the notebook's
    script = tmp_path / "quickstart.py"
    script.write_text("\n\n".join([FEW_STEPS, *("".join(cell["source"]) for cell in code)]))
    environment = {**os.environ, "MPLBACKEND": "agg"}
    result = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "400 splats, stopped by: target" in result.stdout
    assert re.search(
        r"^default: 400 splats, [23]\d\.\d\d dB on 8 held-out", result.stdout, re.MULTILINE
    )
    assert len(nanogs.load(tmp_path / "small.spz")) == 400


NEEDED = ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers")
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]


@pytest.mark.slow
@pytest.mark.skipif(bool(MISSING), reason="mkdocs is not installed: `make docs` installs it")
def test_the_site_can_be_built_and_loads_nothing_from_other_hosts(tmp_path):
    site = tmp_path / "site"
    build = f"{FEW_STEPS}\nfrom mkdocs.__main__ import cli\ncli()"
    result = subprocess.run(
        [sys.executable, "-c", build, "build", "--strict", "--quiet", "--site-dir", site],
        cwd=ROOT, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        text = page.read_text()
        assert "<!-- made:" not in text
        assert not re.findall(r"<(?:script|img|iframe|source)[^>]*(?:https?:)?//[^>]*>", text), page
        assert not re.findall(r"<link[^>]*href=\"?(?:https?:)?//[^>]*>", text), page
    for style in site.rglob("*.css"):
        assert not re.findall(r"url\([\"']?(?:https?:)?//|@import", style.read_text()), style
    pictures = list((site / "pictures").glob("*.png"))
    assert len(pictures) == 4
    assert (site / "pictures" / "curve.svg").read_text().startswith("<svg")
    assert all(picture.read_bytes()[:4] == b"\x89PNG" for picture in pictures)


def test_the_method_page_names_functions_and_numbers_of_the_code():
    text = (DOCS / "method.md").read_text("utf-8")
    named = set(re.findall(r"`(\w+)\.(\w+)`", text)) - {("nanogs", "simplify")}
    named = {(module, name) for module, name in named if name not in ("md", "py")}
    assert ("forest", "grow_forest") in named
    for module, name in named:
        assert hasattr(importlib.import_module(f"nanogs.method.{module}"), name), (module, name)
    default, best = (PRESETS[preset].hidden for preset in ("default", "best"))
    assert f"h = {default}, with `best` {best} " in text
