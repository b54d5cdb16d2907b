"""What the build adds to the documentation: pictures, tables, and pages made of other files.

MkDocs calls the functions `on_...`. A line `<!-- made: NAME -->` in a page stands for
the text that `TEXTS` makes.
"""

import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import commands
import formats
import pictures

ROOT = Path(__file__).resolve().parents[2]
MARKER = re.compile(r"^<!-- made: (.+) -->$", re.MULTILINE)
CODE = re.compile(r"<code>.*?</code>", re.DOTALL)
OPTION = re.compile(r"(?<=[\s>])--?[a-z][a-z0-9-]*(?=[\s<])(?![^<>]*>)")  # not within a tag


def changes() -> str:
    """Return the changelog, with links from docs/ in place of those from the root."""
    return (ROOT / "CHANGELOG.md").read_text("utf-8").replace("](docs/", "](")


TEXTS: Mapping[str, Callable[[], str]] = {
    "what formats keep": formats.kept_table,
    "how precise formats are": formats.precision_table,
    "which way is up": formats.frame_table,
    "scores of the tutorial": lambda: pictures.make().scores,
}
PAGES: Mapping[str, Callable[[], str]] = {
    "reference/commands.md": commands.reference,
    "changes.md": changes,
}
MADE = (*PAGES, *(f"pictures/{name}" for name in pictures.NAMES))
"""What pages may link to although no file of the name is in docs/."""


def on_files(files: Any, config: Any) -> Any:  # noqa: ANN401 - types of MkDocs, which tests lack
    """Add what is made to the files of the site."""
    from mkdocs.structure.files import File

    for name, text in PAGES.items():
        files.append(File.generated(config, name, content=text()))
    for name, content in pictures.make().pictures.items():
        files.append(File.generated(config, f"pictures/{name}", content=content))
    return files


def on_page_markdown(markdown: str, **_others: object) -> str:
    """Put what is made in place of its marker; an unknown one ends the build."""
    return MARKER.sub(lambda match: _text(match[1]), markdown)


def on_page_content(html: str, **_others: object) -> str:
    """Mark the options in code, so that the style sheet keeps each in one line."""
    marked = r'<span class="option">\g<0></span>'
    return CODE.sub(lambda code: OPTION.sub(marked, code[0]), html)


@cache
def _text(name: str) -> str:
    return TEXTS[name]()
