"""A digest of the package's sources, which differ between clones of one version."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def digest_of_sources(apart: Sequence[str]) -> str:
    """Return a short hash of the package's sources, without some of its subpackages."""
    found = hashlib.sha1(usedforsecurity=False)
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.relative_to(PACKAGE).parts[0] not in apart:
            found.update(path.read_bytes())
    return found.hexdigest()[:10]
