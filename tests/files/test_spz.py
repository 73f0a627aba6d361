"""SPZ: round trips are exact up to its precision, another program reads the same, and bombs are not unpacked."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from glassplat.files.spz import HEADER, MAGIC, STREAM, STREAMED_HEADER, read_spz, spz_bytes, write_spz
from glassplat.kernels.project.reference import rotations, sh_basis
from glassplat.scene.gaussians import Gaussians
from tests.files.test_ply import random_gaussians

FLIP = torch.tensor([1.0, -1.0, -1.0])


def typical(coefficients: int = 16, count: int = 50) -> Gaussians:
    """Gaussians within the range of the format."""
    gaussians = random_gaussians(coefficients, count=count)
    gaussians = replace(gaussians, active_sh_degree=gaussians.max_sh_degree)
    return gaussians.with_tensors({"sh": (gaussians.sh * 0.25).clamp(-0.9, 0.9)})


def shapes(gaussians: Gaussians) -> torch.Tensor:
    """Covariances [N, 3, 3]."""
    axes = rotations(gaussians.quats) * torch.exp(gaussians.log_scales)[:, None, :]
    return axes @ axes.mT


def packed(version: int, *sections: bytes, count: int = 1, degree: int = 0, bits: int = 12) -> bytes:
    return gzip.compress(HEADER.pack(MAGIC, version, count, degree, bits, 0, 0) + b"".join(sections), mtime=0)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_written_values_are_read_back(version: int, coefficients: int, tmp_path: Path) -> None:
    before = typical(coefficients)
    write_spz(tmp_path / "a.spz", before, version)
    after = read_spz(tmp_path / "a.spz")
    assert after.active_sh_degree == before.max_sh_degree
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=2**-20)
    torch.testing.assert_close(after.log_scales, before.log_scales, rtol=0, atol=1 / 31)
    torch.testing.assert_close(
        torch.sigmoid(after.logit_opacities), torch.sigmoid(before.logit_opacities), rtol=0, atol=1 / 500
    )
    torch.testing.assert_close(after.sh[:, 0], before.sh[:, 0], rtol=0, atol=0.014)
    torch.testing.assert_close(after.sh[:, 1:], before.sh[:, 1:], rtol=0, atol=1 / 250)
    unit = torch.nn.functional.normalize(before.quats, dim=1)
    assert float((unit * after.quats).sum(1).abs().min()) > 1 - 1e-5


def test_rewriting_a_file_changes_nothing(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", typical())
    first = read_spz(tmp_path / "a.spz")
    write_spz(tmp_path / "b.spz", first)
    second = read_spz(tmp_path / "b.spz")
    for name, tensor in first.tensors().items():
        if name != "quats":  # Their largest component is recomputed.
            assert torch.equal(tensor, second.tensors()[name]), name


@pytest.mark.parametrize("version", [3, 4])
def test_another_program_reads_the_same_in_its_frame(version: int, tmp_path: Path) -> None:
    """gsply keeps the frame of the file, in which y and z are flipped."""
    before = typical()
    write_spz(tmp_path / "a.spz", before, version)
    ours, theirs = read_spz(tmp_path / "a.spz"), gsply.read_spz(str(tmp_path / "a.spz"))
    np.testing.assert_allclose(theirs.means, ours.means * FLIP, atol=1e-6)
    np.testing.assert_allclose(theirs.scales, ours.log_scales, atol=1e-6)
    np.testing.assert_allclose(theirs.sh0, ours.sh[:, 0], atol=1e-5)
    turned = Gaussians(
        *(torch.from_numpy(np.asarray(x)) for x in (theirs.means, theirs.quats, theirs.scales, theirs.opacities)),
        torch.zeros(50, 0, 3),
    )
    flipped = FLIP[:, None] * shapes(ours) * FLIP
    torch.testing.assert_close(shapes(turned), flipped, rtol=1e-3, atol=1e-3)
    rest = torch.from_numpy(np.asarray(theirs.shN)).reshape(50, -1, 3)
    directions = torch.nn.functional.normalize(torch.randn(20, 3), dim=1)
    seen = torch.einsum("dk,nkc->ndc", sh_basis(directions)[:, 1:], ours.sh[:, 1:])
    seen_there = torch.einsum("dk,nkc->ndc", sh_basis(directions * FLIP)[:, 1:], rest)
    torch.testing.assert_close(seen_there, seen, rtol=0, atol=1e-5)


def test_older_versions_are_read(tmp_path: Path) -> None:
    half = np.array([1.5, -2.0, 0.25], dtype="<f2").tobytes()
    fixed = b"".join(int(value * 4096).to_bytes(3, "little", signed=True) for value in (1.5, -2.0, 0.25))
    rest = bytes([128]) + bytes([128] * 3) + bytes([160, 144, 80]) + bytes([255, 128, 128])
    for version, position in ((1, half), (2, fixed)):
        (tmp_path / "a.spz").write_bytes(packed(version, position, rest))
        read = read_spz(tmp_path / "a.spz")
        torch.testing.assert_close(read.means[0], torch.tensor([1.5, 2.0, -0.25]))
        torch.testing.assert_close(read.log_scales[0], torch.tensor([0.0, -1.0, -5.0]))
        torch.testing.assert_close(read.quats[0].abs(), torch.tensor([0.0, 1.0, 0.0039, 0.0039]), rtol=0, atol=1e-3)


@pytest.mark.parametrize("bits", [0x7C01, 0x7DFF, 0xFC01, 0x7E00], ids=hex)
def test_a_nan_position_is_read_without_a_warning(bits: int, tmp_path: Path) -> None:
    """Found by `tools/trial.py readers`: halves may be signalling NaNs, and NumPy warns of arithmetic with those."""
    half = np.array([bits, 0x3C00, 0x3C00], dtype="<u2").tobytes()
    (tmp_path / "a.spz").write_bytes(packed(1, half, bytes(1 + 3 + 3 + 3)))
    means = read_spz(tmp_path / "a.spz").means[0]
    assert torch.isnan(means[0]) and means[1:].abs().tolist() == [1.0, 1.0]


def test_harmonics_of_the_fourth_degree_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(packed(3, bytes(9 + 1 + 3 + 3 + 4), bytes(range(72)), degree=4))
    read = read_spz(tmp_path / "a.spz")
    assert read.sh.shape == (1, 16, 3)
    assert read.sh[0, 15, 2] == 44 / 128 - 1


def test_no_gaussians_at_all(tmp_path: Path) -> None:
    for version in (3, 4):
        write_spz(tmp_path / "a.spz", Gaussians.empty(4), version)
        read = read_spz(tmp_path / "a.spz")
        assert read.sh.shape == (0, 1, 3), "bands that are not in use stay behind"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 5}, "version 5"),
        ({"sh": torch.zeros(50, 0, 3)}, "colours"),
        ({"means": torch.full((50, 3), torch.nan)}, "means"),
        ({"means": torch.full((50, 3), -9e6)}, r"9e\+06 units from the origin, and SPZ ends at 8388607"),
    ],
)
def test_what_cannot_be_written_is_refused(change: dict, words: str, tmp_path: Path) -> None:
    version = change.pop("version", 3)
    gaussians = typical().with_tensors(change) if "sh" not in change else Gaussians(**(typical().tensors() | change))
    with pytest.raises(ValueError, match=words):
        write_spz(tmp_path / "a.spz", gaussians, version)
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.parametrize("log_scale", [-12.0, 8.0])
def test_clipped_sizes_are_reported(log_scale: float, caplog: pytest.LogCaptureFixture) -> None:
    before = typical(count=2000)
    spz_bytes(before)
    flat = before.log_scales.clone()
    flat[:, 2] = -14  # The thickness of a flat Gaussian is not visible.
    spz_bytes(before.with_tensors({"log_scales": flat}))
    flat[:2] = log_scale
    spz_bytes(before.with_tensors({"log_scales": flat}))
    assert not caplog.messages
    flat[:10] = log_scale
    spz_bytes(before.with_tensors({"log_scales": flat}))
    assert "4.5e-05 to 379 units; those of 0.5 % of" in caplog.text and "`glassplat clean --scale`" in caplog.text


def test_positions_rounded_by_more_than_a_gaussian_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    far = typical().means.clone()
    spz_bytes(typical())
    assert not caplog.messages
    far[0, 1] = 1e5
    spz_bytes(typical().with_tensors({"means": far, "log_scales": torch.full((50, 3), -5.0)}))
    assert "rounds positions to 0.015625 units" in caplog.text and "lies 1e+05 units from" in caplog.text


def streamed(count: int, table: list[tuple[int, int]], body: bytes = b"", offset: int = STREAMED_HEADER.size) -> bytes:
    head = STREAMED_HEADER.pack(MAGIC, 4, count, 0, 12, 0, len(table), offset)
    return head + b"".join(STREAM.pack(*row) for row in table) + body


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "not (an )?SPZ"),
        (b"ply\n", "not (an )?SPZ"),
        (gzip.compress(b"short", mtime=0), "within its header"),
        (gzip.compress(b"x" * 100, mtime=0), "not (an )?SPZ"),
        (packed(3)[:20], "header|unpacked|cut off"),
        (packed(9), "version 9"),
        (packed(4), "version 4"),
        (packed(3, degree=5), "degree 5"),
        (packed(3, count=2**32 - 1), "4294967295 Gaussians"),
        (packed(3, bytes(5)), "cut off"),
        (b"\x1f\x8b" + bytes(40), "unpacked"),
        (struct.pack("<II", MAGIC, 4), "within its header"),
        (streamed(1, [])[: STREAMED_HEADER.size - 1], "begins as SPZ of version 4 does, but is cut off"),
        (streamed(1, []), "sections"),
        (streamed(1, [(1, 9)] * 5, offset=2**31), "sections"),
        (streamed(1, [(2**60, 9), (1, 1), (1, 3), (1, 3), (1, 4)]), "section 0"),
        (streamed(1, [(3, 9), (1, 1), (1, 3), (1, 3), (1, 4)], b"xxxxxxx"), "section 0"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused_with_a_message(data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(ValueError, match=words):
        read_spz(tmp_path / "a.spz")


def test_bombs_are_not_unpacked(tmp_path: Path) -> None:
    """A hundred megabytes of zeros after one Gaussian, in either container."""
    zeros = bytes(10**8)
    whole = gzip.compress(HEADER.pack(MAGIC, 3, 1, 0, 12, 0, 0) + zeros, 1, mtime=0)
    stream = zstandard.ZstdCompressor().compress(zeros)
    in_streams = streamed(1, [(len(stream), 9), (1, 1), (1, 3), (1, 3), (1, 4)], stream + bytes(4))
    del zeros
    for data in (whole, in_streams):
        (tmp_path / "a.spz").write_bytes(data)
        tracemalloc.start()
        with suppress(ValueError):
            read_spz(tmp_path / "a.spz")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20e6


SMALL = [spz_bytes(typical(4, count=3), version) for version in (3, 4)]


@given(st.integers(0, 1), st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=6))
def test_mutated_files_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, kind: int, changes: list) -> None:
    data = bytearray(SMALL[1] if kind else gzip.decompress(SMALL[0]))
    for position, value in changes:
        data[position % len(data)] = value
    path = tmp_path_factory.mktemp("spz") / "a.spz"
    path.write_bytes(bytes(data) if kind else gzip.compress(bytes(data), mtime=0))
    with suppress(ValueError):
        assert all(bool(tensor.isfinite().all()) for tensor in read_spz(path).tensors().values())


def test_discs_become_as_flat_as_the_format_can_say(tmp_path: Path) -> None:
    solid = typical()
    write_spz(tmp_path / "a.spz", replace(solid, log_scales=solid.log_scales[:, :2].contiguous()))
    after = read_spz(tmp_path / "a.spz")
    torch.testing.assert_close(after.log_scales[:, :2], solid.log_scales[:, :2], rtol=0, atol=1 / 31)
    assert float(after.log_scales[:, 2].max()) == -10.0
