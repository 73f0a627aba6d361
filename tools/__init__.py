"""Programs for developers of the package: `python -m tools.NAME`."""

# Imported before PyTorch, because it sets how idle threads wait.
import glassplat  # noqa: F401
