"""Compare what plain cuts promise of palettes with what results made for them show.

    python benchmarks/first_palettes.py [SCENES] [--only skull,flowers] [--sizes 0.5MB,1MB]

For each number of splats that share an entry of the palette, the quality of files of equal size,
dB more than with the usual number: of the plain cut by which a search for a size chooses the first
palette, and of brief results, which such a search compares. These have their best bits.
"""

import argparse
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NoReturn
from unittest.mock import patch

import nanogs
from measurements import SCENES
from nanogs.pipeline.search import packer, plain_cuts
from nanogs.pipeline.search.choose_packing import MakeAndMeasure, MeasureFile, choose_packing
from nanogs.pipeline.search.measured_files import MeasuredFiles
from nanogs.pipeline.search.packing import (
    FIRST_PER_ENTRY,
    LARGER_PALETTES,
    SMALLER_PALETTES,
    Packing,
)
from nanogs.report import PackingReport
from nanogs.splats import Splats
from rivals import REAL_SCENES

PALETTES = (*LARGER_PALETTES[::-1], *SMALLER_PALETTES)


class _Done(Exception):  # noqa: N818 - not an error
    """Ends a search for a size once its results are compared."""


def compare_palettes(model: Splats, size: str, suffix: str) -> tuple[list[float], list[float]]:
    """Return the quality for each of `PALETTES` less that of the usual one, dB.

    Returns:
        That of the plain cut, and that of the results.
    """
    promised: list[float] = []
    shown: list[float] = []

    def measure_all(files: MeasuredFiles, measure: MeasureFile) -> list[PackingReport]:
        def value(per_entry: float) -> float:
            return files.value(measure(replace(files.choices.first, per_entry=per_entry)))

        usual = value(FIRST_PER_ENTRY)
        promised.extend(value(each) - usual for each in PALETTES)
        return []

    def make_all(
        files: MeasuredFiles, guess: Callable[[Packing], int], make_and_measure: MakeAndMeasure
    ) -> NoReturn:
        def value(per_entry: float) -> float:
            choices = replace(
                files.choices, degrees=files.choices.degrees[-1:], first_per_entry=per_entry
            )
            own = MeasuredFiles(choices, files.size, files.slope, files.available)
            choose_packing(own, guess, make_and_measure)
            return own.value_of(choices.first)

        usual = value(FIRST_PER_ENTRY)
        shown.extend(value(each) - usual for each in PALETTES)
        raise _Done

    with (
        patch.object(plain_cuts, "measure_palettes", measure_all),
        patch.object(packer, "choose_packing", make_all),
        suppress(_Done),
    ):
        nanogs.simplify(model, size=size, format=suffix)
    return promised, shown


def main() -> None:
    """Print a row for each scene, format and size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="?", type=Path, default=REAL_SCENES)
    parser.add_argument("--only", default="skull,flowers,playbot")
    parser.add_argument("--sizes", default="0.5MB,1MB")
    options = parser.parse_args()
    heads = ("scene", "format", "size", "quality of", *(f"{each:g}" for each in PALETTES))
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for name in options.only.split(","):
        model = nanogs.load(options.scenes / SCENES[name])
        for suffix in ".spz", ".sog":
            for size in options.sizes.split(","):
                found = compare_palettes(model, size, suffix)
                for kind, values in zip(("plain cut", "results"), found, strict=True):
                    row = (name, suffix, size, kind, *(f"{each:+.2f}" for each in values))
                    print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
