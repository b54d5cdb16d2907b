"""Default values that the command's help shows, in a module that imports nothing."""

CHUNK = 1 << 15  # most splats of the finest level in a chunk
LEAST_CHUNK = 1 << 13  # fewest splats in a chunk: a quarter of the most
DEFAULT_MEMORY = 4_000_000_000  # bytes of memory for each process of a job in blocks
PAGE_SPLATS = 100_000  # most splats of a stream that is embedded in a page: some 4 MB
BENCH_RATIOS = (0.1, 0.01, 0.001)  # compaction ratios that `nanogs bench` measures
PATIENCE = 300.0  # seconds that a run waits for workers while there is none
