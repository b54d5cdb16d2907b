"""Encoding a model column by column for formats that need it, from a source read by rows."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack

from nanogs._types import Array
from nanogs.io.temporary import into_temporary, nameless_file
from nanogs.source import InMemory, Source
from nanogs.splats import Splats

Encoder = Callable[[Splats], Array]
"""Encodes one column of the file for a block of splats."""
_PIECE = 1 << 20  # bytes


def encoded_columns(source: Source, encoders: Sequence[Encoder]) -> Iterator[Iterator[bytes]]:
    """Yield an iterator over the encoded bytes of each column; exhaust each before the next.

    A model in memory is traversed once for each column. Other sources are read only once: while
    the first column is yielded, all others are encoded and kept in temporary files.

    Args:
        source: The model.
        encoders: One for each column, in the order of the columns.

    Raises:
        OutputError: A temporary file cannot be written.
    """
    if isinstance(source, InMemory):
        for encode in encoders:
            yield (encode(block).tobytes() for block in source.blocks())
        return
    with ExitStack() as stack:
        files = [stack.enter_context(nameless_file()) for _ in encoders[1:]]

        def first() -> Iterator[bytes]:
            for block in source.blocks():
                with into_temporary():
                    for encode, file in zip(encoders[1:], files, strict=True):
                        file.write(encode(block).tobytes())
                yield encoders[0](block).tobytes()

        yield first()
        for file in files:
            with into_temporary():  # the last bytes are written now
                file.seek(0)
            yield iter(lambda file=file: file.read(_PIECE), b"")  # type: ignore[misc]
