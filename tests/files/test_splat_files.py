"""Splats of other programs: read with their intended meaning; broken files are refused."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from glassplat.files import scene_folder
from glassplat.files.ply import BOUNDS, COLOR_BOUNDS, write_gaussians
from glassplat.files.scene_folder import SPLAT_ROW, read_splats, select_drawable, write_with_gaussforge
from glassplat.files.spz import write_spz
from glassplat.kernels.project.reference import rotations
from glassplat.scene import SH_ZERO
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import with_intensity
from tests.files.test_spz import shapes, typical


def write_compressed(path: Path, gaussians: Gaussians) -> None:
    """Compresses the Gaussians with another program."""
    tensors = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.logit_opacities)
    means, scales, quats, opacities = (tensor.numpy() for tensor in tensors)
    rest = gaussians.sh[:, 1:].numpy()
    data = gsply.GSData.from_arrays(means, scales, quats, opacities, gaussians.sh[:, 0].numpy(), rest)
    data.save(str(path), compressed=True)


def test_a_compressed_ply_of_another_program_is_read(tmp_path: Path) -> None:
    before = typical(16, count=700)
    before = before.with_tensors({"means": 0.5 * before.means, "log_scales": before.log_scales - 3})
    write_compressed(tmp_path / "a.ply", before)
    written = next(tmp_path.iterdir())
    after = read_splats(written)
    # The other program reorders them.
    after = after.select(torch.cdist(before.means, after.means).argmin(dim=1))
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=4e-3)
    torch.testing.assert_close(after.log_scales, before.log_scales, rtol=0, atol=1e-2)
    torch.testing.assert_close(
        torch.sigmoid(after.logit_opacities), torch.sigmoid(before.logit_opacities), atol=5e-3, rtol=0
    )
    torch.testing.assert_close(shapes(after), shapes(before), rtol=0.03, atol=1e-3)
    torch.testing.assert_close(after.sh[:, 0], before.sh[:, 0], rtol=0, atol=0.02)
    torch.testing.assert_close(after.sh[:, 1:], before.sh[:, 1:], rtol=0, atol=0.04)


def test_a_splat_file_is_read(tmp_path: Path) -> None:
    rows = np.zeros(2, dtype=SPLAT_ROW)
    rows["mean"][1], rows["scale"] = (1, 2, 3), (0.5, 1, 2)
    rows["color"], rows["quat"] = (255, 0, 51, 204), (128 + 90, 128, 128 - 90, 128)
    rows.tofile(tmp_path / "a.splat")
    read = read_splats(tmp_path / "a.splat")
    torch.testing.assert_close(read.means[1], torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(read.log_scales[0].exp(), torch.tensor([0.5, 1.0, 2.0]))
    torch.testing.assert_close(torch.sigmoid(read.logit_opacities), torch.full((2,), 0.8))
    torch.testing.assert_close(read.sh[0, 0] * SH_ZERO + 0.5, torch.tensor([1.0, 0.0, 0.2]))
    torch.testing.assert_close(
        rotations(read.quats)[0], torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), atol=1e-6, rtol=0
    )


def test_file_types_are_recognised_by_their_first_bytes(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.spz", typical())
    write_spz(tmp_path / "b.ply", typical(), 4)
    assert torch.equal(read_splats(tmp_path / "a.spz").means, typical().means)
    assert len(read_splats(tmp_path / "b.ply")) == 50
    assert torch.equal(with_intensity(typical()).channels["log_intensity"], torch.zeros(50))


def test_invalid_gaussians_are_left_out_and_counted(tmp_path: Path) -> None:
    gaussians = typical()
    gaussians.means[3], gaussians.quats[5], gaussians.log_scales[7, 1] = torch.nan, 0, 200
    gaussians.sh[9, 4, 1], gaussians.logit_opacities[11] = torch.inf, torch.inf
    gaussians.log_scales[13] = -torch.inf
    kept, lost = select_drawable(gaussians, "a.ply")
    assert (len(kept), lost) == (46, 4)
    assert all(bool(tensor.isfinite().all()) for tensor in kept.tensors().values())
    with pytest.raises(ValueError, match=r"none of the 50 Gaussians in a\.ply"):
        select_drawable(gaussians.with_tensors({"means": torch.full((50, 3), torch.nan)}), "a.ply")


def compressed_header(count: int, chunks: int, kind: str = "uint") -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in BOUNDS] + [f"element vertex {count}"]
    lines += [f"property {kind} packed_{name}" for name in ("position", "rotation", "scale", "color")]
    return ("\n".join(lines) + "\nend_header\n").encode()


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.splat", bytes(33), "32 per Gaussian"),
        ("a.splat", b"", "32 per Gaussian"),
        ("a.obj", b"v 0 0 0", r"not a readable splat file, because it begins with the bytes b'v 0 '; expected one of"),
        ("a.ply", b"", "not a readable splat file, because it is empty; expected one of"),
        ("a.ply", compressed_header(2**60, 2**52) + bytes(64), "cut off"),
        ("a.ply", compressed_header(1, 2) + bytes(112), "2 chunks"),
        ("a.ply", compressed_header(1, 1, "int") + bytes(64), "expected uint"),
    ],
)
def test_files_with_false_sizes_are_refused(name: str, data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=words):
        read_splats(tmp_path / name)


@pytest.mark.parametrize("largest", [3e38, 1e300])
def test_a_compressed_file_with_bounds_out_of_range_does_not_warn(largest: float, tmp_path: Path) -> None:
    header = compressed_header(1, 1).decode().replace("property float", "property double")
    colors = "".join(f"property double {name}\n" for name in COLOR_BOUNDS)
    header = header.replace("element vertex", f"{colors}element vertex")
    bounds = np.full(len(BOUNDS) + len(COLOR_BOUNDS), largest)
    (tmp_path / "a.ply").write_bytes(header.encode() + bounds.tobytes() + bytes(16))
    assert not read_splats(tmp_path / "a.ply").sh.isfinite().all()


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=6))
def test_mutated_files_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, changes: list) -> None:
    data = bytearray(compressed_header(3, 1) + np.arange(48 + 48, dtype=np.uint8).tobytes())
    for position, value in changes:
        data[position % len(data)] = value
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    path.write_bytes(bytes(data))
    with suppress(ValueError):
        kept, _ = select_drawable(read_splats(path), path)
        assert all(bool(tensor.isfinite().all()) for tensor in kept.tensors().values())


def forged(gaussians: Gaussians, path: Path) -> Gaussians:
    """The Gaussians read back from a file of gaussforge, which reorders them."""
    pytest.importorskip("gaussforge")
    write_with_gaussforge(path, gaussians)
    read = read_splats(path)
    return read.select(torch.cdist(gaussians.means, read.means).argmin(dim=1))


@pytest.mark.parametrize("length", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("kind", ["sog", "ksplat"])
def test_rotations_of_any_length_round_trip_in_foreign_files(tmp_path: Path, kind: str, length: float) -> None:
    before = typical(count=200)
    before = before.with_tensors({"quats": length * torch.nn.functional.normalize(before.quats, dim=1)})
    after = forged(before, tmp_path / f"a.{kind}")
    turned = rotations(before.quats.double()).transpose(1, 2) @ rotations(after.quats.double())
    angles = torch.rad2deg(torch.arccos(((turned.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
    assert float(angles.max()) < 1


@pytest.mark.parametrize("kind", ["sog", "ksplat"])
def test_other_programs_files_hold_discs_and_are_never_empty(tmp_path: Path, kind: str) -> None:
    discs = replace(typical(), log_scales=typical().log_scales[:, :2])
    after = forged(discs, tmp_path / f"a.{kind}")
    torch.testing.assert_close(after.log_scales[:, :2], discs.log_scales, rtol=0, atol=0.05)
    assert float(after.log_scales[:, 2].max()) < -9
    with pytest.raises(ValueError, match=rf"no Gaussians to write as .*a\.{kind}; expected one at least"):
        write_with_gaussforge(tmp_path / f"a.{kind}", discs.select(torch.zeros(len(discs), dtype=torch.bool)))


def test_messages_name_the_file_of_another_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_folder, "_gaussforge", lambda path: None)
    monkeypatch.setattr(scene_folder, "_convert", lambda *_: b"ply\n")
    (tmp_path / "a.sog").write_bytes(b"")
    with pytest.raises(ValueError, match=r"the header of .*a\.sog has") as caught:
        read_splats(tmp_path / "a.sog")
    assert "scene.ply" not in str(caught.value)
