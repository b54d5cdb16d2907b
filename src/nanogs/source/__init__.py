"""Models of which some rows are read at a time: in memory, in a file, joined, filtered or turned.

Every reader gives a `Source`; `load` is one whose rows are all read. `Joined`, `Filtered`,
`Turned`, `Reduced` and `Tagged` change rows when they are read, and hold none. What a format has
to do with it is in `io`.
"""

from nanogs.source.base import Layout, Source, joined_rows
from nanogs.source.changed import Filtered, Reduced, Tagged, Turned
from nanogs.source.joined import Joined, fitted, joined_layout
from nanogs.source.whole import InMemory, source_of

__all__ = [
    "Filtered",
    "InMemory",
    "Joined",
    "Layout",
    "Reduced",
    "Source",
    "Tagged",
    "Turned",
    "fitted",
    "joined_layout",
    "joined_rows",
    "source_of",
]
