"""`python -m nanogs`."""

from nanogs.cli import main

main()
