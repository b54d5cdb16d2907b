"""The simplification pipeline, from a request to a report.

`api`, `files`, `levels` and `grown` are the calls, `checks` has what they refuse beforehand,
`stages` is the table of all stages, and `run` runs them in order, for a model in memory
(`in_memory`, `one_block`) or in blocks (`in_blocks`, `work`). The folders hold what these use:
`options`, `estimates`, `tasks` (the work of each stage), `search` and `job`.

Importing this package imports no Numba; the stages do.
"""
