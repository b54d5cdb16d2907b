"""OpenUSD as text, `.usda`."""

from functools import partial

from nanogs.io.format import Format
from nanogs.io.parts import Whole
from nanogs.io.usda import read, write
from nanogs.io.usda.text import START

FORMATS = (
    Format(
        ".usda",
        partial(Whole, inspect=read.inspect, read=read.read),
        write.write,
        losses=write.losses,
        frame="y up or z up as the file says, turned to y down (rdf) when read",
        turns=True,
        starts=(START,),
    ),
)
