"""The simplification pipeline, from a request to a report.

`api` and `files` are the calls, `checks` has what both refuse beforehand, `stages` is the table of
all stages, and `run` runs them in order, for a model in memory (`in_memory`) or in blocks
(`in_blocks`). The folders hold what these use: `options`, `estimates`, `tasks` (the work of each
stage), `search` and `job`.

Importing this package imports no Numba; the stages do.
"""
