"""Plain-PyTorch twins: the definition of every operation and the oracle of its tests. Read these first."""
