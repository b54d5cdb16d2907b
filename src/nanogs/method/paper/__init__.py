"""The published method (arXiv 2603.16103).

Stage 1 is `prune`. `passes` repeats the others: 2 `nanogs.method.graph`, 3 `cost`,
4 `nanogs.method.match` and 5 `merge`. `gaussians` has the splats that they work on.
"""
