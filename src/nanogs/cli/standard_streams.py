"""stdout and stderr that cannot be written: an error for the one, for the other no more messages.

What stdout cannot encode is escaped.
"""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any


@contextmanager
def named_stdout() -> Iterator[None]:
    """Within the context, raise an `OutputError` if stdout cannot be written.

    A pipe that its reader has closed still raises `BrokenPipeError`. A stdout that was closed from
    the start fails only if something is written to it. Text that stdout cannot encode is escaped,
    as on stderr: a file name may hold any bytes, and Windows' code pages lack signs such as ∞.
    """
    stream = sys.stdout
    if stream is None:
        unwritable = os.open(os.devnull, os.O_RDONLY)
        stream = os.fdopen(unwritable, "w", encoding="utf-8")

    def fail(error: OSError) -> None:
        from nanogs.io.atomic import output_error

        raise output_error(Path("stdout"), error) from error

    proxy: Any = _Guarded(stream, fail)
    with redirect_stdout(proxy):
        yield


@contextmanager
def optional_stderr() -> Iterator[None]:
    """Within the context, drop messages from the first one that stderr cannot take, as of a log.

    A long run should not end because its log's disk is full; its exit code says how it went. A pipe
    that its reader has closed still raises `BrokenPipeError`.
    """
    if sys.stderr is None:  # closed from the start: Python drops everything itself
        yield
        return
    proxy: Any = _Guarded(sys.stderr, lambda _: None)
    with redirect_stderr(proxy):
        yield


def discard(stream: Any) -> None:  # noqa: ANN401 - a stream of text or bytes
    """Send all further output, and what is still buffered, to nowhere.

    Python would report an error if the buffers could not be flushed at exit.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class _Guarded:
    """A stream, and its `buffer`; from its first failure, which is handled, it goes nowhere."""

    def __init__(self, stream: Any, handle: Callable[[OSError], None]) -> None:  # noqa: ANN401 - of text or bytes
        self._stream, self._handle = stream, handle

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - any of the stream's
        return getattr(self._stream, name)

    @property
    def buffer(self) -> "_Guarded":
        return _Guarded(self._stream.buffer, self._handle)

    def write(self, data: Any) -> int:  # noqa: ANN401 - text or bytes
        if isinstance(data, str):
            code = self._stream.encoding or "utf-8"
            data = data.encode(code, "backslashreplace").decode(code)
        with self._failures():
            self._stream.write(data)
        return len(data)

    def writelines(self, lines: Any) -> None:  # noqa: ANN401 - several of them
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        with self._failures():
            self._stream.flush()

    @contextmanager
    def _failures(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            raise
        except OSError as error:
            discard(self._stream)
            self._handle(error)
