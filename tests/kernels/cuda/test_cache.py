"""Machine code is loaded from the disk: other processes compile nothing, and damaged or foreign files do no harm."""

from __future__ import annotations

import logging
import os
import runpy
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("numba_cuda", reason="numba-cuda is not installed; `make setup` installs it")

from numba import config
from numba.core import caching

from glassplat.kernels.backend import cpu_cache
from glassplat.kernels.backend import cuda as cache
from glassplat.kernels.backend import cuda as launch
from glassplat.kernels.backend.cuda import ImageCache
from glassplat.kernels.backend.devices import SIMULATED
from glassplat.kernels.maths.fast_maths import exp2_maths, reciprocal_maths
from tests.kernels.test_cache import printed_by
from tools.compile_kernels import without_device

if SIMULATED:
    pytest.skip("the simulator has no compiler", allow_module_level=True)

CAPABILITY = (9, 0)
SMALL_KERNEL = """
import hashlib
import logging
import sys

import numpy as np

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import kernel
from tools.compile_kernels import without_device


def scale_in_place(real):
    factor = real(2)

    @inlined
    def scaled(x):
        return factor * x

    @kernel("scale", real, "real1")
    def scale(values):
        for i in range(values.size):
            values[i] = scaled(values[i])

    return scale


logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
with without_device((9, 0)):
    code = scale_in_place(np.float32)._images.machine_code((9, 0))
print(code.entry, hashlib.sha256(code.cubin).hexdigest())
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder that holds this test's machine code."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def images(factor: float = 2.0, *, arguments: str = "real1") -> ImageCache:
    """The machine code of a small kernel."""
    constant = np.float32(factor)

    def scale(values: Any) -> None:
        values[0] *= constant

    return launch.kernel("scale", np.float32, arguments)(scale)._images


def made(cached: ImageCache, log: pytest.LogCaptureFixture) -> tuple[Any, int]:
    """The machine code, and the number of times the compiler ran for it."""
    log.clear()
    with log.at_level(logging.INFO, logger="glassplat.kernels"), without_device(CAPABILITY):
        code = cached.machine_code(CAPABILITY)
    return code, sum(message.startswith("compiling scale_float32 for this GPU") for message in log.messages)


def test_a_kernel_is_announced_then_cached_for_other_processes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    script = tmp_path / "small_kernel.py"
    script.write_text(SMALL_KERNEL)
    with caplog.at_level(logging.INFO, logger="glassplat.kernels"):
        runpy.run_path(str(script))
    assert len(caplog.messages) == 2
    assert caplog.messages[0] == "compiling scale_float32 for this GPU (first use only, then cached on disk) ..."
    assert caplog.messages[1].startswith("compiled scale_float32 in")
    first = capsys.readouterr().out.splitlines()
    root = str(Path(launch.__file__).parents[3])
    assert printed_by(script, NUMBA_CACHE_DIR=str(tmp_path), PYTHONPATH=root) == first


def test_the_cache_key_depends_on_everything_that_changes_the_machine_code(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = images().key(CAPABILITY)
    assert images().key(CAPABILITY) == plain
    others = [
        images(3.0).key(CAPABILITY),
        images(arguments="real2").key(CAPABILITY),
        images().key((8, 0)),
    ]
    monkeypatch.setattr(cache, "compiler_versions", lambda: "numba-cuda of another version")
    others.append(images().key(CAPABILITY))
    assert len({plain, *others}) == 5


def test_each_compute_capability_has_its_file(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    codes = []
    for capability in ((8, 0), (9, 0)):
        with without_device(capability):
            codes.append(images().machine_code(capability))
    assert codes[0].cubin != codes[1].cubin
    assert len(list(folder.rglob("*.nbc"))) == 2
    assert made(images(), caplog) == (codes[1], 0)


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize(
    "damage",
    [lambda data: b"", lambda data: data[: len(data) // 2], lambda data: b"something else altogether"],
    ids=["empty", "cut short", "foreign"],
)
def test_a_damaged_or_foreign_file_is_replaced(
    damage: Callable[[bytes], bytes], suffix: str, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made(images(), caplog)
    (file,) = folder.rglob(f"*.{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    code, compiled = made(images(), caplog)
    assert compiled == 1
    assert made(images(), caplog) == (code, 0)


def test_machine_code_of_which_a_bit_was_lost_is_not_loaded(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    made(images(), caplog)
    (file,) = folder.rglob("*.nbc")
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    code, compiled = made(images(), caplog)
    assert compiled == 1 and made(images(), caplog) == (code, 0)


def test_another_kernel_that_was_written_at_the_same_time_is_not_loaded(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made(images(3.0), caplog)
    (file,) = folder.rglob("*.nbc")
    content = file.read_bytes()
    file.unlink()
    (index,) = folder.rglob("*.nbi")
    index.unlink()
    made(images(2.0), caplog)
    file.write_bytes(content)
    code, compiled = made(images(2.0), caplog)
    assert compiled == 1 and made(images(2.0), caplog) == (code, 0)


def test_machine_code_is_stored_elsewhere_if_the_package_is_read_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "file").touch()  # No user, not even root, can create a folder in it.
    monkeypatch.setattr(config, "CACHE_DIR", str(folder / "file"))
    monkeypatch.setattr(cpu_cache.UserFolder, "from_function", classmethod(lambda *arguments: None))
    monkeypatch.setattr(caching.InTreeCacheLocator, "ensure_cache_path", refused)
    monkeypatch.setattr(
        cpu_cache.TemporaryFolder, "ensure_cache_path", lambda self: os.makedirs(self.get_cache_path(), exist_ok=True)
    )
    monkeypatch.setattr(cpu_cache, "_temporary_root", lambda: str(folder))
    code, compiled = made(images(), caplog)
    assert compiled == 1 and made(images(), caplog) == (code, 0)


def refused(self: object) -> None:
    raise PermissionError("read-only")


def test_a_file_made_from_other_code_is_replaced(caplog: pytest.LogCaptureFixture) -> None:
    first, _ = made(images(2.0), caplog)
    second, compiled = made(images(3.0), caplog)
    assert compiled == 1
    assert second.cubin != first.cubin


def test_an_interrupted_write_leaves_the_old_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first, _ = made(images(2.0), caplog)

    def fails(*arguments: object) -> None:
        raise OSError("disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", fails)
        code, _ = made(images(3.0), caplog)
    assert code.cubin[:4] == b"\x7fELF"
    assert not list(folder.rglob("*.tmp.*"))
    assert made(images(2.0), caplog) == (first, 0)


def test_the_loader_gets_what_the_disk_has(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    loaded: list[tuple[Any, int]] = []
    entered: list[int] = []

    def load(code: Any, name: str, index: int, layout: Any) -> str:
        loaded.append((code, index))
        return f"kernel {len(loaded)}"

    monkeypatch.setattr(launch, "LoadedKernel", load)
    monkeypatch.setattr(launch, "current_gpu", lambda index: nullcontext(entered.append(index)))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: CAPABILITY)
    kept, _ = made(images(), caplog)
    caplog.clear()
    scale = launch.Kernel(images()._function, "scale_float32", images()._signature)
    with caplog.at_level(logging.INFO, logger="glassplat.kernels"):
        assert [scale._on_device(index) for index in (0, 1, 0)] == ["kernel 1", "kernel 2", "kernel 1"]
    assert loaded == [(kept, 0), (kept, 1)]
    assert entered == [0, 1]
    assert caplog.messages == []


def test_the_cache_key_depends_on_requested_instructions() -> None:
    def key(maths: Callable[[type], Any]) -> str:
        instruction = maths(np.float32)

        def apply(values: Any) -> None:
            values[0] = instruction(values[0])

        return launch.kernel("apply", np.float32, "real1")(apply)._images.key(CAPABILITY)

    assert key(exp2_maths) == key(exp2_maths) != key(reciprocal_maths)
