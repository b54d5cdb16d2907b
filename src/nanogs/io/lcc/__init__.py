"""`.lcc` of XGRIDS' scanners: levels of detail, in a grid of cells on the ground."""

from nanogs.io.format import Format
from nanogs.io.lcc.read import open_level

FORMATS = (
    Format(
        ".lcc",
        open_level,
        open_level=open_level,
        frame="z up (rfu) in the file, turned to y down (rdf) when read",
        turns=True,
        rounds=True,
    ),
)
