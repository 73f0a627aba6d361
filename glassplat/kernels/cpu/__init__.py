"""Numba kernels for the CPU. A kernel's file has the name of its operation."""
