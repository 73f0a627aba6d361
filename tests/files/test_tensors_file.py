"""Tensors with a header, on full disks and from foreign files."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from glassplat.cli.console import describe_os_error
from glassplat.files import sidecars
from glassplat.files.sidecars import open_tensors, system_error, write_equirect, write_tensors

TENSORS = {"a": torch.arange(1000.0), "b": torch.zeros(0, 3)}


@contextmanager
def no_file_beyond(size: int) -> Iterator[None]:
    """Limits the size of this process's files, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(
    ("said", "number"),
    [
        ("Error while serializing: I/O error: No space left on device (os error 28)", errno.ENOSPC),
        ('Failed to write pixel data to image file "x.exr". No space left on device.', errno.ENOSPC),
        ("Error while serializing: HeaderTooLarge", None),
    ],
)
def test_a_full_disk_is_recognised_by_its_errno(said: str, number: int | None) -> None:
    error = system_error(said)
    assert (error.errno, error.filename) == (number, None) and said in str(error)
    assert describe_os_error(error).endswith("; free some space") == (number is not None)


@pytest.mark.parametrize("name", ["a.safetensors", "a.exr"])
def test_system_errors_keep_their_errno(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("old")
    with no_file_beyond(4000), pytest.raises(OSError, match=r"could not write .* are unchanged") as caught:
        if name == "a.exr":
            write_equirect(tmp_path / name, torch.rand(64, 128, 3))
        else:
            write_tensors(tmp_path / name, {"a": torch.zeros(10_000)}, {})
    assert caught.value.errno == errno.EFBIG
    assert (tmp_path / name).read_text() == "old"


def test_tensors_and_header_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, TENSORS, {"format": "x-1", "step": 3})
    with open_tensors(path, "x-1", "an x") as file:
        read = file.tensors()
        assert file.header["step"] == 3
    assert read.keys() == TENSORS.keys() and all(torch.equal(read[name], TENSORS[name]) for name in read)


def test_a_full_disk_raises_oserror_and_keeps_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, TENSORS, {"format": "x-1"})
    before = path.read_bytes()
    with no_file_beyond(2000), pytest.raises(OSError, match=r"could not write .*File too large.*unchanged"):
        write_tensors(path, TENSORS, {"format": "x-1"})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_the_file_has_the_usual_permissions(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_tensors(tmp_path / "a.safetensors", TENSORS, {})
    finally:
        os.umask(before)
    assert (tmp_path / "a.safetensors").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (None, "has format None; expected 'x-1'"),
        ('{"format": "y"}', "has format 'y'; expected 'x-1'"),
        ("[]", "the header of .* is|has format"),
        ("{", "the header of .* is not valid JSON"),
        ("[" * 100_000, "the header of .* is nested"),
    ],
)
def test_a_foreign_header_is_named(tmp_path: Path, header: str | None, message: str) -> None:
    path = tmp_path / "a.safetensors"
    save_file(TENSORS, path, metadata=None if header is None else {"glassplat": header})
    with pytest.raises(ValueError, match=message), open_tensors(path, "x-1", "an x"):
        pass


@pytest.mark.parametrize("size", [10, 100_000])
def test_a_file_that_is_replaced_while_it_is_opened_is_opened_again(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, TENSORS, {"format": "x-1", "step": 1})
    files: list[object] = []

    def replacing(name: Path, framework: str) -> object:
        files.append(safe_open(name, framework=framework))
        if len(files) == 1:
            write_tensors(path, {"a": torch.ones(size)}, {"format": "x-1", "step": 2})
            if size < 1000:
                raise RuntimeError("there are fewer bytes than the header of the first file says")
        return files[-1]

    monkeypatch.setattr(sidecars, "safe_open", replacing)
    with open_tensors(path, "x-1", "an x") as file:
        assert file.header["step"] == 2 and torch.equal(file.tensors()["a"], torch.ones(size))
    assert len(files) == 2


@pytest.mark.parametrize("kept", [0, 7, 100, 1000])
def test_a_file_that_is_cut_off_is_named(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "a.safetensors"
    write_tensors(path, TENSORS, {"format": "x-1"})
    os.truncate(path, kept)
    with (
        pytest.raises(ValueError, match=r"a\.safetensors is truncated or not an x"),
        open_tensors(path, "x-1", "an x"),
    ):
        pass


def test_paths_that_are_not_files_are_named(tmp_path: Path) -> None:
    with (
        pytest.raises(FileNotFoundError, match="absent does not exist"),
        open_tensors(tmp_path / "absent", "x-1", "an x"),
    ):
        pass
    with pytest.raises(ValueError, match="cannot be read"), open_tensors(tmp_path, "x-1", "an x"):
        pass


def test_a_long_reason_is_truncated(tmp_path: Path) -> None:
    header = b'{"a": {"dtype": "F32", "shape": "%s"}}' % (b"x" * 5000)
    (tmp_path / "a.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
    with (
        pytest.raises(ValueError, match=r"truncated or not a test .*; expected a complete") as caught,
        open_tensors(tmp_path / "a.safetensors", "x", "a test"),
    ):
        pass
    assert len(str(caught.value)) < 500 + len(str(tmp_path))


def test_a_folder_whose_name_is_not_unicode_can_be_read(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    write_tensors(folder / "a.safetensors", {"a": torch.ones(2)}, {"format": "x"})
    with open_tensors(folder / "a.safetensors", "x", "a test") as opened:
        assert opened.tensors()["a"].tolist() == [1, 1]
