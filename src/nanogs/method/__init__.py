"""The simplification methods: one module for each stage, called by `nanogs.pipeline`.

The stages of the published method are in `paper`.
"""
