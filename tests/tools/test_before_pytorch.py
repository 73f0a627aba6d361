"""The tools import the package before PyTorch, which reads only once how threads should wait."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WHAT_IS_SET = """
import importlib, os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            print(os.environ.get("OMP_WAIT_POLICY"))
            sys.exit(0)

sys.meta_path.insert(0, Watch())
importlib.import_module(sys.argv[1])
print("no PyTorch")
"""


@pytest.mark.parametrize("name", ["same_bits", "page_likeness", "compile_kernels"])
def test_threads_wait_as_the_package_says(name: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    command = [sys.executable, "-c", WHAT_IS_SET, f"tools.{name}"]
    environment["PYTHONPATH"] = str(ROOT)
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() in (["PASSIVE"], ["no", "PyTorch"])
