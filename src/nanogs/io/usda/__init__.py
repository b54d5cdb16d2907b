"""OpenUSD text files, `.usda`."""

from nanogs.io.format import Format
from nanogs.io.usda import write
from nanogs.io.usda.read import UsdaFile
from nanogs.io.usda.text import START

FORMATS = (
    Format(
        ".usda",
        UsdaFile,
        write.write,
        losses=write.losses,
        frame="y up or z up as the file says, turned to y down (rdf) when read",
        turns=True,
        magic=(START,),
    ),
)
