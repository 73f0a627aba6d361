"""How good a run is, and how methods compare."""
