"""Measurements of speed: `python -m bench`."""

# Before PyTorch, as whoever uses the package should: it says how threads wait.
import glassplat  # noqa: F401
