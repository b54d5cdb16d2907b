"""Estimates made before a run: memory of each stage, division into blocks, and durations."""
