"""Measurements: of speed, `python -m benchmarks`; of quality over scenes, `python -m benchmarks.compare`."""

# Before PyTorch, as whoever uses the package should: it says how threads wait.
import glassplat  # noqa: F401
