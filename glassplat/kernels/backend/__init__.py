"""Compilation, caching and launching of kernels, on threads and devices."""
