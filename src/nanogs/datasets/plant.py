"""The bundled real scene: a potted plant, captured and trained by Marcel Padilla."""

from importlib.resources import as_file, files

from nanogs.io import load
from nanogs.splats import Splats

CREDIT = "a potted plant by Marcel Padilla, CC-BY-4.0, https://github.com/marcelpadilla/splats"
"""The licence requires this credit wherever the scene is distributed, changed or not."""


def load_plant() -> Splats:
    """Load the bundled plant: 113,648 splats of SH degree 0, y down."""
    with as_file(files("nanogs.datasets") / "plant.sog") as path:
        return load(path)
