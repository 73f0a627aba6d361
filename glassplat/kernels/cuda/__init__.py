"""Numba kernels for NVIDIA GPUs. A kernel's file has the name of its operation; importing one needs numba-cuda."""
