from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from glassplat.files.sidecars import read_equirect, write_equirect
from glassplat.kernels.maths.images import linear_from_srgb


def panorama(height: int = 6) -> torch.Tensor:
    return torch.rand(height, 2 * height, 3, generator=torch.Generator().manual_seed(0))


def write_channels(path: Path, channels: dict[str, np.ndarray]) -> None:
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))


@pytest.mark.parametrize(("suffix", "tolerance"), [(".exr", 1e-6), (".EXR", 1e-6), (".png", 0.5 / 255 + 1e-6)])
def test_a_panorama_round_trips(tmp_path: Path, suffix: str, tolerance: float) -> None:
    image = panorama()
    image[0, 0], image[0, 1] = 0, 1
    write_equirect(tmp_path / f"sky{suffix}", image)
    read = read_equirect(tmp_path / f"sky{suffix}")
    assert read.dtype == torch.float32
    torch.testing.assert_close(read, image, atol=tolerance, rtol=0)


def test_an_exr_holds_linear_radiance(tmp_path: Path) -> None:
    image = panorama()
    write_equirect(tmp_path / "sky.exr", image)
    with OpenEXR.File(str(tmp_path / "sky.exr")) as file:
        stored = torch.from_numpy(np.array(file.channels()["RGB"].pixels))
    torch.testing.assert_close(stored, linear_from_srgb(image))


def test_half_floats_transparency_and_light_brighter_than_white_are_read(tmp_path: Path) -> None:
    pixels = np.full((2, 4, 4), 7.0, dtype=np.float16)
    pixels[1, :, :3] = 0.5
    write_channels(tmp_path / "sky.exr", {"RGBA": pixels})
    read = read_equirect(tmp_path / "sky.exr")
    assert bool((read[0] == 1).all())
    torch.testing.assert_close(read[1], torch.full((4, 3), 0.7353570), atol=1e-5, rtol=0)


def test_files_that_are_not_a_panorama_are_named(tmp_path: Path) -> None:
    write_equirect(tmp_path / "sky.exr", panorama(40))
    whole = (tmp_path / "sky.exr").read_bytes()
    for name, contents in (("half.exr", whole[: len(whole) // 2]), ("text.exr", b"no image"), ("empty.exr", b"")):
        (tmp_path / name).write_bytes(contents)
        with pytest.raises(ValueError, match=f"cannot read .*{name} as OpenEXR"):
            read_equirect(tmp_path / name)
    write_channels(tmp_path / "grey.exr", {"Y": np.zeros((2, 4), np.float32)})
    with pytest.raises(ValueError, match=r"channels \['Y'\]; expected R, G and B"):
        read_equirect(tmp_path / "grey.exr")
    write_channels(tmp_path / "square.exr", {"RGB": np.zeros((2, 3, 3), np.float32)})
    with pytest.raises(ValueError, match="3 x 2 pixels; expected an equirectangular image, twice as wide as high"):
        read_equirect(tmp_path / "square.exr")
    Image.new("L", (4, 2)).save(tmp_path / "grey.png")
    with pytest.raises(ValueError, match=r"grey\.png is grey; expected a panorama in colour"):
        read_equirect(tmp_path / "grey.png")
    whole = bytearray((tmp_path / "square.exr").read_bytes() + bytes(2**16))  # Space for a table of all lines.
    window = whole.index(b"dataWindow") + len("dataWindow.box2i.") + 4
    whole[window : window + 16] = np.array([0, 0, 2**16 - 1, 2**15 - 1], "<i4").tobytes()
    (tmp_path / "vast.exr").write_bytes(whole)
    Image.new("1", (2**14, 2**13)).save(tmp_path / "vast.png")
    for name, size in (("vast.exr", "65536 x 32768"), ("vast.png", "16384 x 8192")):
        with pytest.raises(ValueError, match=f"{size} pixels; .* of at most 34 megapixels"):
            read_equirect(tmp_path / name)
    write_channels(tmp_path / "nan.exr", {"RGB": np.full((2, 4, 3), np.nan, np.float32)})
    with pytest.raises(ValueError, match="non-finite"):
        read_equirect(tmp_path / "nan.exr")
    with pytest.raises(FileNotFoundError, match="no panorama at"):
        read_equirect(tmp_path / "missing.png")


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"use the suffix \.exr or \.png"):
        write_equirect(tmp_path / "sky.hdr", panorama())
    with pytest.raises(ValueError, match=r"expected \(H, 2 H, 3\)"):
        write_equirect(tmp_path / "sky.exr", torch.zeros(4, 4, 3))
    with pytest.raises(ValueError, match="non-finite"):
        write_equirect(tmp_path / "sky.png", torch.full((4, 8, 3), torch.inf))
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="could not write"):
        write_equirect(tmp_path / "file" / "sky.exr", panorama())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
