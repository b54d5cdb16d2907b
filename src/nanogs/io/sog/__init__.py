"""PlayCanvas' SOG: splats in lossless pictures; with levels of detail, streamed SOG."""

from nanogs.io.format import Format
from nanogs.io.registry import LEVELS
from nanogs.io.sog import write
from nanogs.io.sog.levels import open_level
from nanogs.io.sog.read import META, SogSource

FORMATS = (
    Format(
        ".sog",
        SogSource,
        write.write,
        tells=True,
        losses=write.losses,
        leaps=write.leaps,
        holds=META,
    ),
    Format(
        META,
        SogSource,
        losses=write.losses,
        write_folder=write.write_folder,
        ours=write.ours,
    ),
    Format(LEVELS, open_level, open_level=open_level),
)
