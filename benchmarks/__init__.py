"""Measurements over scenes: `python -m benchmarks.compare`."""
