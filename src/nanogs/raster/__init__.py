"""Cameras and the CPU rasteriser."""
