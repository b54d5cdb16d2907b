"""`.lcc` and `.lcc2` of XGRIDS' scanners: levels of detail, in cells on the ground or an octree."""

from nanogs.io.format import Format
from nanogs.io.lcc.octree import open_octree
from nanogs.io.lcc.read import open_level

FORMATS = tuple(
    Format(
        suffix,
        opened,
        open_level=opened,
        frame="z up (rfu) in the file, turned to y down (rdf) when read",
        turns=True,
        rounds=True,
    )
    for suffix, opened in ((".lcc", open_level), (".lcc2", open_octree))
)
