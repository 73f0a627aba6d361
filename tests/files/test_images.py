"""Reading and writing of image files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import PIL
import pytest
import torch
from PIL import ExifTags, Image

from glassplat.files.images import (
    image_size,
    is_transparent,
    open_image,
    read_colors,
    read_image,
    read_image_float,
    resize_by_area,
    write_image,
)
from tests.files.profiles import IN_P3, IN_SRGB, p3_profile, srgb_profile

GENERATOR = np.random.default_rng(0)


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 1), (5, 7, 3), (5, 7, 4)])
def test_eight_bit_images_round_trip(tmp_path: Path, shape: tuple[int, ...]) -> None:
    pixels = GENERATOR.integers(0, 256, shape, dtype=np.uint8)
    write_image(tmp_path / "a.png", pixels)
    read = read_image(tmp_path / "a.png")
    assert read.shape == (5, 7, shape[2] if len(shape) == 3 else 1)
    np.testing.assert_array_equal(read, pixels.reshape(read.shape))
    np.testing.assert_allclose(read_image_float(tmp_path / "a.png"), read / 255, atol=1e-6)


def test_floats_are_clamped_and_rounded(tmp_path: Path) -> None:
    image = torch.tensor([[-1.0, 0.0, 0.5], [0.2, 1.0, 3.0]], requires_grad=True)
    write_image(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[:, :, 0], [[0, 0, 128], [51, 255, 255]])


def test_sixteen_bit_grey_keeps_its_precision(tmp_path: Path) -> None:
    values = np.array([[0, 1, 300], [32768, 65534, 65535]], dtype=np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_image_float(tmp_path / "a.png")[:, :, 0], values / 65535, atol=1e-7)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[:, :, 0], np.round(values / 257.0))


def test_palette_and_transparency(tmp_path: Path) -> None:
    palette = Image.new("P", (4, 3), 1)
    palette.putpalette([0, 0, 0, 200, 100, 50])
    palette.save(tmp_path / "palette.png")
    np.testing.assert_array_equal(read_image(tmp_path / "palette.png")[0, 0], [200, 100, 50])
    palette.save(tmp_path / "clear.png", transparency=1)
    np.testing.assert_array_equal(read_image(tmp_path / "clear.png")[0, 0], [200, 100, 50, 0])
    assert image_size(tmp_path / "clear.png") == image_size(tmp_path / "palette.png") == (4, 3)
    assert is_transparent(tmp_path / "clear.png")
    assert not is_transparent(tmp_path / "palette.png")


@pytest.mark.parametrize("alpha", [255, 254, 0])
def test_an_image_is_transparent_where_a_pixel_is(tmp_path: Path, alpha: int) -> None:
    pixels = np.full((3, 4, 4), 255, dtype=np.uint8)
    pixels[2, 1, 3] = alpha
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert is_transparent(tmp_path / "a.png") == (alpha < 255)


def test_orientation_tag_is_not_applied(tmp_path: Path) -> None:
    """Poses and intrinsics refer to the stored pixels."""
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (8, 4)).save(tmp_path / "a.jpg", exif=exif)
    assert read_image(tmp_path / "a.jpg").shape == (4, 8, 3)


@pytest.mark.parametrize(
    ("orientation", "options"),
    [*((number, {}) for number in range(1, 9)), (6, {"compression": "tiff_lzw"}), (6, {"icc_profile": p3_profile()})],
)
def test_a_tiff_is_read_as_a_png_with_the_same_tag(tmp_path: Path, orientation: int, options: dict[str, Any]) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    image = Image.fromarray(GENERATOR.integers(0, 256, (4, 6, 3), dtype=np.uint8))
    image.save(tmp_path / "a.tif", exif=exif, **options)
    image.save(tmp_path / "a.png", exif=exif, icc_profile=options.get("icc_profile"))
    assert image_size(tmp_path / "a.tif") == open_image(tmp_path / "a.tif").size == (6, 4)
    for read in (read_image, read_colors):
        np.testing.assert_array_equal(read(tmp_path / "a.tif"), read(tmp_path / "a.png"))
    Image.fromarray(np.asarray(image.convert("L")).astype(np.uint16) * 257).save(tmp_path / "b.tif", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "b.tif")[:, :, 0], np.asarray(image.convert("L")))


@pytest.mark.parametrize("read", [read_image, read_colors, read_image_float, image_size, open_image, is_transparent])
def test_files_that_cannot_be_read(tmp_path: Path, read) -> None:
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "nothing.png")
    (tmp_path / "text.png").write_text("text")
    with pytest.raises(ValueError, match=r"text\.png as an image"):
        read(tmp_path / "text.png")


def test_header_of_absurd_size_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.bmp"
    Image.new("RGB", (4, 3)).save(path)
    content = bytearray(path.read_bytes())
    content[18:26] = (10**6).to_bytes(4, "little") * 2  # Width and height.
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.bmp as an image"):
        read_image(path)


def test_an_image_too_large_to_decode_is_named_with_its_size(tmp_path: Path) -> None:
    path = tmp_path / "a.bmp"
    Image.new("RGB", (4, 3)).save(path)
    content = bytearray(path.read_bytes())
    content[18:26] = (12_000).to_bytes(4, "little") * 2
    path.write_bytes(content)
    for read in (image_size, read_image, is_transparent):
        with pytest.raises(ValueError, match=r"a\.bmp as an image \(it is 12000x12000 .* at most 134 megapixels"):
            read(path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.full((3, 4), np.nan, dtype=np.float32), "floating-point numbers; expected colours"),
        (np.full((3, 4), 10**6, dtype=np.int32), "values from 1000000 to 1000000; expected colours"),
        (np.full((3, 4), -1, dtype=np.int32), "values from -1 to -1; expected colours"),
    ],
)
def test_mask_values_of_unknown_scale_are_refused(tmp_path: Path, values: np.ndarray, message: str) -> None:
    Image.fromarray(values).save(tmp_path / "a.tif", icc_profile=p3_profile())
    for read in (open_image, read_image, read_colors, read_image_float):
        with pytest.raises(ValueError, match=rf"a\.tif as an image \(it holds {message}"):
            read(tmp_path / "a.tif")


def test_code_embedded_in_an_image_is_not_executed(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 3\nshowpage\n")
    with pytest.raises(ValueError, match=r"a\.png as an image"):
        read_image(tmp_path / "a.png")


OLD_PILLOW = pytest.mark.xfail(int(PIL.__version__.partition(".")[0]) < 13, reason="Pillow before 13 reads none")


@pytest.mark.parametrize(
    "mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", pytest.param("YCbCr", marks=OLD_PILLOW), "LAB", "I", "I;16"]
)
def test_every_way_to_store_colours_is_read(tmp_path: Path, mode: str) -> None:
    Image.new(mode, (5, 4)).save(tmp_path / "a.tif")
    assert read_image(tmp_path / "a.tif").shape[:2] == read_image_float(tmp_path / "a.tif").shape[:2] == (4, 5)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P"])
def test_colours_of_another_profile_become_srgb(tmp_path: Path, mode: str) -> None:
    image = Image.new("RGB", (5, 4), IN_P3)
    if mode == "P":
        image = image.quantize(4)
    if mode == "RGBA":
        image.putalpha(7)
    image.save(tmp_path / "a.png", icc_profile=p3_profile())
    expected = [*IN_SRGB, 7] if mode == "RGBA" else list(IN_SRGB)
    np.testing.assert_allclose(read_colors(tmp_path / "a.png")[2, 3], expected, atol=1)
    assert read_image(tmp_path / "a.png")[2, 3, :3].tolist() == list(IN_P3)


@pytest.mark.parametrize(("index", "expected"), [("R03", (230, 79, 56)), ("R98", (200, 80, 60))])
def test_adobe_rgb_marked_only_by_exif_becomes_srgb(tmp_path: Path, index: str, expected: tuple) -> None:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {ExifTags.Interop.InteropIndex: index}
    Image.new("RGB", (16, 16), (200, 80, 60)).save(tmp_path / "a.jpg", quality=100, subsampling=0, exif=exif)
    np.testing.assert_allclose(read_colors(tmp_path / "a.jpg")[3, 3], expected, atol=2)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "I;16"])
def test_greys_of_a_colour_profile_stay_grey(tmp_path: Path, mode: str) -> None:
    shade, expected = {"1": (1, 255), "I;16": (200 * 257, 200), "LA": ((200, 255), 200)}.get(mode, (200, 200))
    Image.new(mode, (5, 4), shade).save(tmp_path / "a.png", icc_profile=p3_profile())
    np.testing.assert_allclose(read_colors(tmp_path / "a.png")[..., :3], expected, atol=1)


@pytest.mark.parametrize(
    "profile",
    [None, srgb_profile(), b"", b"no profile", p3_profile()[:300], srgb_profile()[:90]],
    ids=["none", "sRGB", "empty", "noise", "P3 cut off", "sRGB cut off"],
)
@pytest.mark.parametrize("mode", ["RGB", "CMYK"])
def test_colours_without_another_profile_are_unchanged(tmp_path: Path, profile: bytes | None, mode: str) -> None:
    pixels = GENERATOR.integers(0, 256, (40, 30, 3), dtype=np.uint8)
    Image.fromarray(pixels).convert(mode).save(tmp_path / "a.tif", icc_profile=profile)
    np.testing.assert_array_equal(read_colors(tmp_path / "a.tif"), read_image(tmp_path / "a.tif"))


def test_an_rgb_profile_is_ignored_for_cmyk(tmp_path: Path) -> None:
    Image.new("CMYK", (5, 4), (9, 99, 200, 3)).save(tmp_path / "a.tif", icc_profile=p3_profile())
    np.testing.assert_array_equal(read_colors(tmp_path / "a.tif"), read_image(tmp_path / "a.tif"))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_cut_off_file_is_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    write_image(path, GENERATOR.integers(0, 256, (40, 40, 3), dtype=np.uint8))
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(ValueError, match=rf"a\.{suffix} as an image"):
        read_image(path)


@pytest.mark.parametrize(
    ("name", "image", "error", "message"),
    [
        ("a.png", np.zeros((2, 2, 2), dtype=np.uint8), ValueError, r"got \[2, 2, 2\]"),
        ("a.png", np.zeros((0, 2, 3), dtype=np.uint8), ValueError, r"got \[0, 2, 3\]"),
        ("a.png", np.zeros((2, 2, 3), dtype=np.int64), TypeError, "got int64"),
        ("a.png", torch.full((2, 2), float("nan")), ValueError, "non-finite"),
        ("a.xyz", np.zeros((2, 2, 3), dtype=np.uint8), ValueError, "image format of .*a.xyz"),
    ],
)
def test_images_that_cannot_be_written(tmp_path: Path, name: str, image, error: type, message: str) -> None:
    (tmp_path / name).write_text("old")
    with pytest.raises(error, match=message):
        write_image(tmp_path / name, image)
    assert (tmp_path / name).read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_system_errors_about_a_file_are_quoted_alone(tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    with pytest.raises(ValueError, match=r"^cannot read .*a\.png as an image \(Is a directory\); replace"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("new", [(4, 6), (5, 3), (7, 9), (15, 12), (1, 1)])
def test_an_image_is_averaged_over_the_exact_area_of_each_new_pixel(new: tuple[int, int]) -> None:
    """Compared with a grid fine enough that all edges of old and new pixels lie on it."""
    pixels = np.random.default_rng(0).integers(0, 256, (10, 9, 3), dtype=np.uint8)
    fine = np.kron(pixels.astype(np.float64), np.ones((new[0], new[1], 1)))
    expected = fine.reshape(new[0], 10, new[1], 9, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(resize_by_area(pixels, new[1], new[0]), expected, rtol=1e-5)
    np.testing.assert_array_equal(resize_by_area(pixels[..., 0], 9, 10), pixels[..., 0])
