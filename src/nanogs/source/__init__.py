"""Models that are read some rows at a time: in memory, in a file, joined, filtered or turned.

Every reader of a file gives a `Source`; `load` reads all its rows. `Joined`, `Filtered`, `Turned`,
`Posed`, `Reduced` and `Tagged` are lazy: they change rows when these are read, and hold none.
`Noted` changes none, and keeps their notes. What depends on a format is in `io`.
"""

from nanogs.source.base import Layout, Source, joined_rows, span_of
from nanogs.source.changed import Filtered, Noted, Posed, Reduced, Tagged, Turned, turned_source
from nanogs.source.joined import Joined, fitted, joined_layout
from nanogs.source.whole import InMemory, refuse_no_model, source_of

__all__ = [
    "Filtered",
    "InMemory",
    "Joined",
    "Layout",
    "Noted",
    "Posed",
    "Reduced",
    "Source",
    "Tagged",
    "Turned",
    "fitted",
    "joined_layout",
    "joined_rows",
    "refuse_no_model",
    "source_of",
    "span_of",
    "turned_source",
]
