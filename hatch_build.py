"""Build hooks: the viewer of `nanogs view` is bundled, and the README is made fit for PyPI."""

import importlib.util
import os
import re
import runpy
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://)([^)]+)\)")


class ViewerHook(BuildHookInterface):
    """Makes src/nanogs/view/viewer.js, unless NANOGS_NO_VIEWER=1 or it is there and current."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Node, where the machine has none and the bundle is to be made."""
        return [] if _unwanted() else _bundle(self.root).requirements()

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Make the bundle; any failure ends the build and says why."""
        del version
        if _unwanted():
            self.app.display_warning(
                "NANOGS_NO_VIEWER is set: built without `nanogs view`, `nanogs studio` and .html"
                " files"
            )
            return
        bundle = _bundle(self.root)
        bundle.build()
        build_data["artifacts"].append(bundle.TARGET.relative_to(self.root).as_posix())


class ProjectPageHook(MetadataHookInterface):
    """Gives the package's page the README, with links that lead somewhere from there.

    NANOGS_REPOSITORY is where the sources are, such as https://github.com/OWNER/nanogs: the release
    sets it. Without it the page has the words of relative links alone, and names no addresses.
    """

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the README, and the project's addresses where they are known."""
        root, home = Path(self.root), os.environ.get("NANOGS_REPOSITORY", "").rstrip("/")
        version = runpy.run_path(str(root / "src/nanogs/_version.py"))["__version__"]
        text = (root / "README.md").read_text(encoding="utf-8")
        text = detached(text, f"{home}/{{}}/v{version}" if home else "")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
        if home:
            metadata["urls"] = {
                "Homepage": home,
                "Documentation": f"{home}/blob/v{version}/docs/index.md",
                "Changelog": f"{home}/blob/v{version}/CHANGELOG.md",
                "Issues": f"{home}/issues",
            }


def detached(text: str, base: str) -> str:
    """Markdown whose relative links do not depend on where it lies.

    Args:
        text: The Markdown.
        base: Address of the repository's files, with `{}` for how they are shown: `blob` as pages,
            `raw` as they are. Empty: links become their words, and pictures go.
    """

    def replaced(link: re.Match[str]) -> str:
        picture, words, target = link.groups()
        if not base:
            return "" if picture else words
        return f"{picture}[{words}]({base.format('raw' if picture else 'blob')}/{target})"

    return LINK.sub(replaced, text)


def _unwanted() -> bool:
    return os.environ.get("NANOGS_NO_VIEWER", "0") not in ("", "0")


def _bundle(root: str) -> ModuleType:
    path = Path(root) / "viewer" / "bundle.py"
    spec = importlib.util.spec_from_file_location("nanogs_viewer_bundle", path)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
