"""Access to the folder that a studio was started in, and to nothing outside it."""

import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from stat import S_ISDIR, S_ISREG
from typing import Any

from nanogs.errors import OptionError
from nanogs.io import registry
from nanogs.io.urls import can_be_name


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder whose files are named by paths relative to it; no path may lead out of it.

    Attributes:
        root: The folder, links resolved.
    """

    root: Path

    def inside(self, text: object) -> Path:
        """Resolve a relative path and its symbolic links; it need not exist.

        Args:
            text: A relative path with slashes; empty for the folder itself.

        Raises:
            OptionError: It leads out of the folder, or is not a path.
        """
        if not isinstance(text, str) or "\\" in text or not can_be_name(text):
            raise OptionError("A file is named by a path relative to the folder of the studio.")
        parts = PurePosixPath(text).parts
        outside = text.startswith("/") or ".." in parts or PureWindowsPath(text).drive
        found = self.root
        if not outside:
            found = Path(os.path.realpath(self.root / text))
        if outside or not found.is_relative_to(self.root):
            raise OptionError(f"{text} leads out of the folder of the studio; name a file in it.")
        return found

    def listed(self, text: object) -> dict[str, Any]:
        """List a subfolder for a file dialogue, without hidden files and links that lead out.

        Raises:
            OptionError: It leads out, or is not a folder that can be read.
        """
        folder = self.inside(text)
        try:
            names = sorted(entry.name for entry in folder.iterdir())
        except OSError as error:
            raise OptionError(f"{text or '.'}: {error.strerror}; choose another folder.") from None
        relative = folder.relative_to(self.root)
        above = None if folder == self.root else _text(relative.parent)
        entries = [self._entry(folder / name) for name in names if not name.startswith(".")]
        shown = [entry for entry in entries if entry is not None]
        shown.sort(key=lambda entry: (entry["kind"] != "folder", entry["name"].lower()))
        return {"folder": _text(relative), "parent": above, "entries": shown}

    def _entry(self, path: Path) -> dict[str, Any] | None:
        """Describe an entry; None if it leads out, or is no file or folder that can be read."""
        real = Path(os.path.realpath(path))
        if not real.is_relative_to(self.root):
            return None
        try:
            facts = real.stat()
        except OSError:  # removed meanwhile, a link to nothing, or in a folder that is locked
            return None
        if S_ISDIR(facts.st_mode):
            return {"name": path.name, "kind": "folder", "bytes": None}
        if not S_ISREG(facts.st_mode):
            return None
        known = registry.find(path)
        kind = "model" if known is not None and known.readable else "file"
        return {"name": path.name, "kind": kind, "bytes": facts.st_size}


def _text(relative: Path) -> str:
    return "" if relative == Path() else relative.as_posix()
