"""The work of each stage on one block of a scene, one module for each stage or for what some share.

The table of the stages, in the order in which they run, is `nanogs.pipeline.stages`.
"""
