"""Measurements of speed (`python -m benchmarks`) and of quality over scenes (`python -m benchmarks.compare`)."""

# Imported before PyTorch, because it sets how idle threads wait.
import glassplat  # noqa: F401
