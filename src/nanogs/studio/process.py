"""Handle of the worker process: starting it, sending messages, receiving them, ending it."""

import multiprocessing
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from nanogs.cleanup import on_signal, starting_processes
from nanogs.studio.scene import Scene, StudioSettings

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess

_GRACE = 2.0  # seconds to clean up after SIGTERM


class Process:
    """The worker process, which is started by the constructor."""

    def __init__(
        self, scene: Scene, settings: StudioSettings, on_message: Callable[[Any], None]
    ) -> None:
        """Start the process.

        Args:
            scene: The scene that it opens.
            settings: Settings of the studio.
            on_message: Called in a thread with each message of the worker; None when it has ended.
        """
        from nanogs.studio.worker import work

        context = multiprocessing.get_context("spawn")
        self._line, theirs = context.Pipe()
        self._process: BaseProcess = context.Process(
            target=work, args=(theirs, scene, settings), daemon=True
        )
        with starting_processes():
            self._process.start()
            self._forget = on_signal(self.end)
        theirs.close()
        threading.Thread(target=_read, args=(self._line, on_message), daemon=True).start()

    def send(self, message: tuple[str, Any]) -> None:
        """Send a message to the worker; nothing happens if it has ended."""
        with suppress(OSError):
            self._line.send(message)

    def end(self) -> None:
        """End the worker, which has `_GRACE` seconds to remove its temporary files."""
        with suppress(OSError, ValueError, AttributeError):
            self._process.terminate()
            self._process.join(_GRACE)
            if self._process.is_alive():
                self._process.kill()
                self._process.join(_GRACE)
        self._forget()

    @property
    def ended_by(self) -> str:
        """Signal or exit code with which it ended, as the end of a sentence."""
        code = self._process.exitcode
        if code is not None and code < 0:
            name = signal.Signals(-code).name
            return f"{name}, as when memory runs out" if name == "SIGKILL" else name
        return f"exit code {code}"


def _read(line: Connection, on_message: Callable[[Any], None]) -> None:
    """Pass on messages until the worker ends, then None; closes the connection."""
    with line, suppress(EOFError, OSError):
        while True:
            on_message(line.recv())
    on_message(None)
