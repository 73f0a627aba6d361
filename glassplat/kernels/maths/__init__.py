"""Scalar maths, with adjoints, that CPU and CUDA kernels share: one formula, one function."""
