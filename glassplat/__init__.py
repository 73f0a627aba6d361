"""glassplat: Gaussian splatting for scenes with window panes, showcases and mirrors."""

import os

# PyTorch and Numba each keep a pool of threads. Waiting threads that spin, as OpenMP's do unless told otherwise, take
# the cores from the other pool: a training step then costs up to twice as much. It is read once, when OpenMP loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
