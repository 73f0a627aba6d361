"""Programs for who works on the package: `python -m tools.NAME`."""

# Before PyTorch, as whoever uses the package should: it says how threads wait.
import glassplat  # noqa: F401
