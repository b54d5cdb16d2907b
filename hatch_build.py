"""Build hook: the viewer of `nanogs view` is bundled before the package is."""

import importlib.util
import os
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


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
            self.app.display_warning("NANOGS_NO_VIEWER is set: built without `nanogs view`")
            return
        bundle = _bundle(self.root)
        bundle.build()
        build_data["artifacts"].append(bundle.TARGET.relative_to(self.root).as_posix())


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
