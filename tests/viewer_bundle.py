"""The script that bundles the viewer, as a module; and the bundle, for tests that need it."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def bundle_script(root=ROOT):
    path = root / "viewer" / "bundle.py"
    spec = importlib.util.spec_from_file_location("viewer_bundle_script", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def require_bundle():
    """Fail, and never skip: an installation from these sources has the viewer."""
    if not bundle_script().is_current():
        pytest.fail("the viewer is not bundled from these sources: python viewer/bundle.py")
