"""A small compiled kernel, and scripts that run it in a separate process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

FORMULA = """
from glassplat.kernels.backend.cpu import inlined

OFFSET = 0


def scaling(real):
    factor = real(2)

    @inlined
    def scaled(x):
        return factor * x + OFFSET

    return scaled
"""

SMALL_KERNEL = """
import logging
import sys

import numpy as np

from glassplat.kernels.backend.cpu import kernel

from formula import scaling

logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)


def scale_in_place(real):
    scaled = scaling(real)

    @kernel("scale", real, parallel=False)
    def scale(values):
        for i in range(values.size):
            values[i] = scaled(values[i])

    return scale


if __name__ == "__main__":
    values = np.ones(2, np.float32)
    scale = scale_in_place(np.float32)
    scale(values)
    scale(values)
    print(values.tolist(), "compiled", scale.compilations)
"""


def printed_by(script: Path, **environment: str) -> list[str]:
    """Lines printed by a Python script in a separate process."""
    done = subprocess.run(
        [sys.executable, str(script)], env=os.environ | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()
