import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from glassplat.files.ply import read_gaussians, write_gaussians
from glassplat.scene import SH_ZERO
from glassplat.scene.gaussians import Gaussians

COUNT = 7
PLAIN = ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def random_gaussians(coefficients: int, channels: tuple[str, ...] = (), count: int = COUNT) -> Gaussians:
    generator = torch.Generator().manual_seed(coefficients)
    return Gaussians(
        means=torch.randn(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.randn(count, 3, generator=generator),
        logit_opacities=torch.randn(count, generator=generator),
        sh=torch.randn(count, coefficients, 3, generator=generator),
        channels={name: torch.randn(count, generator=generator) for name in channels},
    )


def header_of(path: Path) -> list[str]:
    return path.read_bytes().split(b"end_header\n")[0].decode().splitlines()


def write_ply(path: Path, ply_format: str, names: list[str], body: bytes, count: int, before: str = "") -> None:
    header = f"ply\nformat {ply_format} 1.0\ncomment by hand\n{before}element vertex {count}\n"
    header += "".join(f"property float {name}\n" for name in names)
    path.write_bytes(header.encode() + b"end_header\n" + body)


@pytest.mark.parametrize("coefficients", [0, 1, 4, 9, 16])
@pytest.mark.parametrize("channels", [(), ("log_intensity", "logit_mark"), ("logit_strength",)])
def test_every_tensor_round_trips_bit_for_bit(tmp_path: Path, coefficients: int, channels: tuple[str, ...]) -> None:
    original = random_gaussians(coefficients, channels)
    write_gaussians(tmp_path / "a.ply", original)
    read = read_gaussians(tmp_path / "a.ply")
    assert read.tensors().keys() == original.tensors().keys()
    for name, tensor in original.tensors().items():
        assert torch.equal(read.tensors()[name], tensor), name
        assert read.tensors()[name].is_contiguous()
    assert read.active_sh_degree == max(original.max_sh_degree, 0)


def test_special_values_round_trip(tmp_path: Path) -> None:
    original = random_gaussians(1)
    original.logit_opacities[:4] = torch.tensor([float("inf"), -0.0, 1e-42, 3.4e38])
    write_gaussians(tmp_path / "a.ply", original)
    read = read_gaussians(tmp_path / "a.ply").logit_opacities
    assert torch.equal(read.view(torch.int32), original.logit_opacities.view(torch.int32))


def test_no_gaussians_at_all(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", Gaussians.empty(16, ("log_intensity",)))
    read = read_gaussians(tmp_path / "a.ply")
    assert len(read) == 0
    assert read.sh.shape == (0, 16, 3)


def test_properties_come_in_the_standard_order(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", random_gaussians(4, ("log_intensity",)))
    names = [line.split()[-1] for line in header_of(tmp_path / "a.ply") if line.startswith("property")]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(9)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "log_intensity"]
    assert names == expected


def test_higher_bands_are_stored_channel_by_channel(tmp_path: Path) -> None:
    gaussians = random_gaussians(4, count=1)
    write_gaussians(tmp_path / "a.ply", gaussians)
    row = np.frombuffer((tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1], "<f4")
    red, green, blue = gaussians.sh[0, 1:].T
    np.testing.assert_array_equal(row[9:18], torch.cat([red, green, blue]).numpy())
    np.testing.assert_array_equal(row[3:6], np.zeros(3))


@pytest.mark.parametrize("ply_format", ["ascii", "binary_big_endian", "binary_little_endian"])
def test_any_order_and_any_format(tmp_path: Path, ply_format: str) -> None:
    names = ["quality", *reversed(PLAIN), "nx", "log_intensity"]
    values = np.random.default_rng(3).normal(size=(COUNT, len(names))).astype(np.float32)
    text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in values).encode()
    body = {
        "ascii": text,
        "binary_big_endian": values.astype(">f4").tobytes(),
        "binary_little_endian": values.tobytes(),
    }
    write_ply(tmp_path / "a.ply", ply_format, names, body[ply_format], COUNT)
    read = read_gaussians(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.means, values[:, [names.index(name) for name in "xyz"]])
    np.testing.assert_array_equal(read.quats, values[:, [names.index(f"rot_{i}") for i in range(4)]])
    assert list(read.channels) == ["log_intensity"]
    assert read.sh.shape == (COUNT, 0, 3)


@pytest.mark.parametrize(("kind", "white"), [("u1", 255), ("f4", 1)])
def test_plain_colours_stand_in_for_harmonics(tmp_path: Path, kind: str, white: int) -> None:
    """nerfstudio writes such files with `--ply-color-mode rgb`."""
    geometry = [*"xyz", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    row = np.dtype([*((name, "<f4") for name in geometry), *((name, f"<{kind}") for name in ("red", "green", "blue"))])
    rows = np.ones(2, dtype=row)
    rows["red"], rows["green"] = white, 0
    rows["blue"] = 51 if kind == "u1" else 0.2
    names = {"u1": "uchar", "f4": "float"}
    header = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    header += [f"property {names[row[name].str[-2:]]} {name}" for name in row.names or ()] + ["end_header", ""]
    (tmp_path / "a.ply").write_bytes("\n".join(header).encode() + rows.tobytes())
    read = read_gaussians(tmp_path / "a.ply")
    assert read.active_sh_degree == 0
    torch.testing.assert_close(read.sh[:, 0] * SH_ZERO + 0.5, torch.tensor([[1, 0, 0.2]] * 2), rtol=0, atol=1e-6)


def test_doubles_and_an_element_in_front_are_read(tmp_path: Path) -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement camera 2\nproperty uchar id\nproperty float focal\n"
    header += "element vertex 1\n" + "".join(f"property double {name}\n" for name in PLAIN) + "end_header\n"
    body = struct.pack("<BfBf", 1, 2.0, 3, 4.0) + struct.pack("<11d", *range(11))
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    assert read_gaussians(tmp_path / "a.ply").means.tolist() == [[0.0, 1.0, 2.0]]


def test_a_truncated_file_is_refused_with_the_number_of_rows(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", random_gaussians(1))
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-5])
    with pytest.raises(ValueError, match="announces 7 rows of 'vertex', but only 6 are complete; copy or export"):
        read_gaussians(tmp_path / "a.ply")


def test_a_truncated_text_file_is_refused_with_the_number_of_rows(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", "ascii", PLAIN, b"0 1 2 3 4 5 6 7 8 9 10\n0 1 2", 2)
    with pytest.raises(ValueError, match="announces 2 rows of 'vertex', but only 1 are complete"):
        read_gaussians(tmp_path / "a.ply")


def test_an_absurd_count_is_refused_before_memory_is_allocated(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", "binary_little_endian", PLAIN, b"", 10**15)
    with pytest.raises(ValueError, match="only 0 are complete"):
        read_gaussians(tmp_path / "a.ply")


def test_an_unsupported_compressed_file_is_refused_with_an_export_hint(tmp_path: Path) -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
    header += "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    (tmp_path / "a.ply").write_bytes(header.encode() + b"end_header\n" + bytes(20))
    with pytest.raises(ValueError, match=r"compressed PlayCanvas/SuperSplat PLY; expected .* `glassplat export`"):
        read_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["x", "y", "z"], "looks like a point cloud and lacks opacity .*Give a trained splat"),
        ([name for name in PLAIN if name != "scale_1"], "lacks scale_1; expected .*another kind of method"),
        ([*PLAIN, "f_dc_0", "f_dc_1"], "lacks the colour properties \\['f_dc_2'\\]"),
        ([*PLAIN, "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0"], "has 1 f_rest properties; expected 0, 9, 24 or 45"),
        ([*PLAIN, "x"], "property 'x' appears twice"),
    ],
)
def test_a_foreign_file_is_refused_with_what_is_missing(tmp_path: Path, names: list[str], message: str) -> None:
    write_ply(tmp_path / "a.ply", "binary_little_endian", names, bytes(4 * len(names)), 1)
    with pytest.raises(ValueError, match=message):
        read_gaussians(tmp_path / "a.ply")


def test_a_mesh_is_refused_as_a_mesh(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 0\n"
    (tmp_path / "a.ply").write_text(header)
    with pytest.raises(ValueError, match="looks like a mesh"):
        read_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not a PLY file"),
        (b"\x89PNG\r\n\x1a\n", "is not a PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nprop", "no 'end_header' line"),
        (b"ply\nelement vertex 0\nend_header\n", "no 'format' line"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "cannot read the line 'element vertex -1'"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n", "cannot read the property line"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty\nend_header\n",
            "the property line 'property'",
        ),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list\nend_header\n", "cannot read the property line"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float\nend_header\n", "cannot read the property line"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 10000000\nend_header\n", "has no properties"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty uchar x\nend_header\n300\n", "'x' of .* is 300 somewhere"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty uchar x\nend_header\nnan\n", "'x' of .* is nan somewhere"),
        (b"ply\nformat ascii 1.0\nend_header\n", "has no element 'vertex'"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\nabc\n", "not a number"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 1\n"
            b"property float x\nend_header\n" + bytes(9),
            "stores lists before element 'vertex'",
        ),
    ],
)
def test_a_damaged_file_ends_in_one_message(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_gaussians(tmp_path / "a.ply")


def test_numbers_beyond_single_precision_become_infinite(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    header += "".join(f"property double {name}\n" for name in PLAIN) + "end_header\n"
    (tmp_path / "a.ply").write_text(header + "1e300 -1e300 0 0 0 0 0 1 0 0 0\n")
    assert read_gaussians(tmp_path / "a.ply").means.tolist() == [[float("inf"), -float("inf"), 0.0]]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nothing\.ply"):
        read_gaussians(tmp_path / "nothing.ply")


def test_a_channel_that_could_not_be_read_back_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot store channels \\['intensity'\\]"):
        write_gaussians(tmp_path / "a.ply", random_gaussians(1, ("intensity",)))
    assert not list(tmp_path.iterdir())


def test_standard_attributes_are_no_channels(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", random_gaussians(4, ("log_intensity",)))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"float log_intensity", b"float log_scales"))
    read = read_gaussians(tmp_path / "a.ply")
    assert not read.channels and read.log_scales.shape[1] == 3


def test_discs_have_two_scales_in_the_file_and_when_read_back(tmp_path: Path) -> None:
    solid = random_gaussians(4, ("logit_strength",))
    original = Gaussians(**{**vars(solid), "log_scales": solid.log_scales[:, :2].contiguous()})
    write_gaussians(tmp_path / "a.ply", original)
    names = [line.split()[-1] for line in header_of(tmp_path / "a.ply") if line.startswith("property")]
    assert [name for name in names if name.startswith("scale")] == ["scale_0", "scale_1"]
    read = read_gaussians(tmp_path / "a.ply")
    assert read.are_discs
    for name, tensor in original.tensors().items():
        assert torch.equal(read.tensors()[name], tensor), name


def test_a_file_of_discs_from_elsewhere_is_read(tmp_path: Path) -> None:
    names = [name for name in PLAIN if name != "scale_2"]
    body = np.arange(3 * len(names), dtype="<f4")
    write_ply(tmp_path / "a.ply", "binary_little_endian", names, body.tobytes(), 3)
    read = read_gaussians(tmp_path / "a.ply")
    assert read.are_discs and len(read) == 3
    assert read.log_scales[0].tolist() == [names.index("scale_0"), names.index("scale_1")]
