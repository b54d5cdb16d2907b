"""Rendering on a graphics card: kernels in Warp, which also run on its CPU device.

Source of the language: Macklin, "Warp: A High-performance Python Framework for GPU Simulation and
Graphics", 2022. Formulas and constants are those of `nanogs.kernels`; only the order of summation
differs, so that pictures differ from the CPU's by rounding. Warp is not imported before a device is
asked for.
"""
