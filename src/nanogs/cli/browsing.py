"""Opening a page in a browser."""

import os
import sys


def show_page(address: str, name: str, asked: bool | None, *, quiet: bool) -> None:
    """Open a page in a browser, or warn that none could be started.

    Args:
        address: Its URL.
        name: Its name in the warning.
        asked: Whether to open it; None to open it if the session is interactive and graphical.
        quiet: Whether a program reads the output; the page is then opened only if `asked` is True.
    """
    import webbrowser

    from nanogs.cli.console import warn

    wanted = asked if asked is not None else not quiet and _has_screen()
    if wanted and not webbrowser.open(address):
        warn(f"No browser could be started; open {name} in one.")


def _has_screen() -> bool:
    """Return whether the output is a terminal and the system can show windows."""
    from nanogs.cli.console import err, out

    graphical = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return err.is_terminal and out.is_terminal and graphical
