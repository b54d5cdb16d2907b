"""Entry point of `python -m nanogs`."""

from nanogs.cli import main

main()
