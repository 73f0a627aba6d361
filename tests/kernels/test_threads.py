"""Threading layers of kernels: TBB is never chosen by accident, and Numba's work queue never serves two threads."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

import pytest

from glassplat.kernels.backend import cpu as threads

PARALLEL_KERNEL = """
import logging
import sys
import threading

import numba
import numpy as np

from glassplat.kernels.backend.cpu import kernel

logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)


def doubled_in_place(name):
    @kernel(name, np.float32)
    def doubled(values):
        for i in numba.prange(values.size):
            values[i] = 2 * values[i]

    return doubled
"""
TWO_KERNELS = """
values = np.ones(2, np.float32)
doubled_in_place("first")(values)
doubled_in_place("second")(values)
print(values.tolist(), numba.threading_layer())
"""
ONE_KERNEL = """
doubled_in_place("first")(np.ones(2, np.float32))
print(numba.threading_layer())
"""
TWO_PYTHON_THREADS = """
doubled = doubled_in_place("doubled")
doubled(np.ones(1, np.float32))
sys.setswitchinterval(1e-6)


def work(values):
    for _ in range(300):
        values[:] = 1
        doubled(values)


shared_out = [np.zeros(20_000, np.float32) for _ in range(2)]
workers = [threading.Thread(target=work, args=(values,)) for values in shared_out]
for worker in workers:
    worker.start()
for worker in workers:
    worker.join()
print(all((values == 2).all() for values in shared_out), numba.threading_layer())
"""
STAND_IN = """
import numba.np.ufunc
from numba.np.ufunc import parallel, workqueue

parallel._check_tbb_version_compatible = lambda: None
numba.np.ufunc.tbbpool = workqueue
"""
"""Makes Numba believe that it has found TBB, on a machine without it."""


def tbb_folder() -> Path | None:
    """Folder of the library of the `tbb` package from PyPI."""
    try:
        files = importlib.metadata.files("tbb") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    return next((Path(file.locate()).resolve().parent for file in files if file.name == "libtbb.so.12"), None)


def has_tbb() -> bool:
    """True if TBB can be loaded without further setup."""
    try:
        ctypes.CDLL("libtbb.so.12")
    except OSError:
        return False
    return True


def printed_with_tbb(tmp_path: Path, script: str, **environment: str) -> list[str]:
    """Output of a script in a process that finds TBB: PyPI's, the system's, or a stand-in."""
    folder = tbb_folder()
    path = {"LD_LIBRARY_PATH": f"{folder}:{os.environ.get('LD_LIBRARY_PATH', '')}"} if folder else {}
    head = "" if folder or has_tbb() else STAND_IN
    return printed(tmp_path, head + PARALLEL_KERNEL + script, **environment, **path)


def printed(tmp_path: Path, script: str, **environment: str) -> list[str]:
    """Output of a script about threads, in a process without other settings of Numba."""
    file = tmp_path / "script.py"
    file.write_text(script)
    plain = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_THREADING")}
    own = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "NUMBA_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, str(file)], env=plain | own | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return [line for line in done.stdout.splitlines() if not line.startswith("compil")]


def test_an_installed_tbb_is_not_used_and_logged_once(tmp_path: Path) -> None:
    said, result = printed_with_tbb(tmp_path, TWO_KERNELS)
    layer = result.split()[-1]
    assert layer in ("omp", "workqueue")
    assert said == f"kernels run on 2 threads of {threads.LAYER_NAMES[layer]}"
    assert result.startswith("[4.0, 4.0]")


def test_tbb_is_not_loaded_if_the_environment_changes_before_the_first_kernel(tmp_path: Path) -> None:
    # Numba then reads all its variables again, and forgets those set in between.
    change = 'import os\nos.environ["NUMBA_DEVELOPER_MODE"] = "0"\n'
    *_, result = printed_with_tbb(tmp_path, change + ONE_KERNEL)
    assert result in ("omp", "workqueue")


@pytest.mark.parametrize(
    "asked", [{"NUMBA_THREADING_LAYER": "tbb"}, {"NUMBA_THREADING_LAYER_PRIORITY": "tbb omp workqueue"}], ids=str
)
def test_tbb_is_used_on_request(tmp_path: Path, asked: dict[str, str]) -> None:
    said, result = printed_with_tbb(tmp_path, ONE_KERNEL, **asked)
    assert said == "kernels run on 2 threads of TBB"
    assert result == "tbb"


def test_two_python_threads_may_use_kernels_on_the_work_queue(tmp_path: Path) -> None:
    # Without a lock Numba ends the process: "Concurrent access has been detected".
    said, result = printed(tmp_path, PARALLEL_KERNEL + TWO_PYTHON_THREADS, NUMBA_THREADING_LAYER="workqueue")
    assert said == "kernels run on 2 threads of Numba's work queue"
    assert result == "True workqueue"


@pytest.mark.parametrize(("layer", "locked"), [("omp", False), ("tbb", False), ("workqueue", True)])
def test_only_the_work_queue_uses_a_lock(layer: str, locked: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def compiled(value: int) -> bool:
        return value == 1 and threads._work_queue_lock.locked()

    monkeypatch.setattr(threads, "threading_layer", lambda: layer)
    enter = threads.serialised(compiled)
    assert enter(1) is locked
    assert (enter is compiled) is not locked
    assert not threads._work_queue_lock.locked()
