"""Defaults that the help of the command states, where naming them imports nothing else."""

CHUNK = 1 << 15  # splats of the finest level in a chunk, at most
LEAST_CHUNK = 1 << 13  # splats in a chunk, at least: a quarter of the most
DEFAULT_MEMORY = 4_000_000_000  # bytes that a process may take of a job in blocks
PAGE_SPLATS = 100_000  # of a stream in a page, at most: some 4 MB
PATIENCE = 300.0  # seconds that a run waits for workers where there is none
