"""Pages that a command opens in a browser."""

import os
import sys


def show_page(address: str, name: str, asked: bool | None, *, quiet: bool) -> None:
    """Open a page in a browser, or say that none could be started.

    Args:
        address: Its URL.
        name: What the user calls it.
        asked: Whether it is to be opened; None for yes where someone sits at a screen.
        quiet: Whether a program reads the output, who is not asked for a look.
    """
    import webbrowser

    from nanogs.cli.console import warn

    wanted = asked if asked is not None else not quiet and _has_screen()
    if wanted and not webbrowser.open(address):
        warn(f"No browser could be started; open {name} in one.")


def _has_screen() -> bool:
    """Whether someone sits at a terminal whose browser would have a window."""
    from nanogs.cli.console import err, out

    graphical = sys.platform in ("win32", "darwin") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return err.is_terminal and out.is_terminal and graphical
