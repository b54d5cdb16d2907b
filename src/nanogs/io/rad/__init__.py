"""Spark's `.rad`: chunks of splats packed column by column, usually with a level-of-detail tree."""

from nanogs.io.format import Format
from nanogs.io.rad import write
from nanogs.io.rad.header import MAGIC, MAX_DEGREE, named_files
from nanogs.io.rad.read import RadFile

FORMATS = (
    Format(
        write.SUFFIX,
        RadFile,
        write.write,
        losses=write.losses,
        open_level=RadFile,
        streams=True,
        max_degree=MAX_DEGREE,
        rounds=True,
        magic=(MAGIC,),
        named_files=named_files,
    ),
)
