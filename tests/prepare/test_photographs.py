"""Photographs as stored by devices are read upright, in colour, and named so that masks can be named after them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from glassplat.errors import InputError
from glassplat.prepare.colmap import _camera_key
from glassplat.prepare.photographs import Note, Photograph, capture_names, photographs_in, read_photograph
from tests.files.profiles import IN_P3, IN_SRGB, p3_profile
from tests.prepare.conftest import Heard

SIZE = (120, 90)
TELEPHONE = Path(__file__).parents[1] / "data_files" / "telephone.heic"
"""Taken upright: a white bar on the left, a green rectangle at the upper right; stored rotated by a right angle."""


def picture(seed: int = 0, size: tuple[int, int] = SIZE) -> Image.Image:
    """Noise with a red corner at the upper left."""
    pixels = np.random.default_rng(seed).integers(0, 100, (size[1], size[0], 3), dtype=np.uint8)
    pixels[: size[1] // 3, : size[0] // 3] = (250, 10, 10)
    return Image.fromarray(pixels)


def three(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(3):
        picture(seed).save(folder / f"{seed}.png")
    return folder


def found(folder: Path, heard: Heard, max_size: int = 1600) -> dict[str, Photograph]:
    return {one.path.name: one for one in photographs_in(folder, max_size, heard)}


def notes_of(heard: Heard) -> list[str]:
    return [message.text for message in heard if isinstance(message, Note)]


def corner(photograph: Photograph) -> tuple[int, ...]:
    """Colour near the upper left."""
    return tuple(int(value) for value in read_photograph(photograph)[10, 10])


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["turned.jpg", "turned.tif"])
def test_photographs_stand_upright(orientation: int, name: str, tmp_path: Path, heard: Heard) -> None:
    folder, upright = three(tmp_path / "in"), picture(9)
    undone = {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }
    stored = upright.transpose(undone[orientation]) if orientation in undone else upright
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Model] = "camera"
    stored.save(folder / name, exif=exif, quality=95)
    photograph = found(folder, heard)[name]
    assert (photograph.width, photograph.height, photograph.device) == (*SIZE, "camera")
    assert corner(photograph)[0] > 200 and corner(photograph)[1] < 60


@pytest.mark.parametrize("mode", ["CMYK", "L", "RGBA", "P", "I;16"])
def test_every_kind_of_pixel_becomes_colour(mode: str, tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    if mode == "I;16":
        image = Image.fromarray((np.asarray(picture(9).convert("L")).astype(np.uint16)) * 257)
    else:
        image = picture(9).convert(mode)
    image.save(folder / "other.tif")
    pixels = read_photograph(found(folder, heard)["other.tif"])
    assert pixels.shape == (90, 120, 3) and pixels.dtype == np.uint8
    corner, elsewhere = pixels[:30, :40].mean(axis=(0, 1)), pixels[40:].mean(axis=(0, 1))
    assert corner[0] > elsewhere[0] + 20
    if mode not in ("L", "I;16"):
        assert corner[0] > 200 and corner[1] < 60


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "RGB"])
def test_cut_out_parts_are_black(mode: str, tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    pixels = np.full((90, 120, 4), 200, dtype=np.uint8)
    pixels[:, :, 3] = np.repeat([0, 128, 255], 40)
    image = Image.fromarray(pixels)
    if mode in ("RGBA", "LA"):
        image.convert(mode).save(folder / "cut.png")
    else:  # One of its colours is transparent.
        shades = image.convert("RGB")
        shades.paste((9, 9, 9), (0, 0, 40, 90))
        shades = shades.quantize(4) if mode == "P" else shades
        shades.save(folder / "cut.png", transparency=shades.getpixel((0, 0)))
    row = read_photograph(found(folder, heard)["cut.png"])[45]
    (note,) = notes_of(heard)
    assert note.startswith("Transparent parts of 1 of 4 photographs become black (cut.png)")
    assert not row[:36].any() and (row[84:] == 200).all()
    if mode in ("RGBA", "LA"):
        assert (row[46:74] == 100).all()


@pytest.mark.parametrize("orientation", [1, 6])
def test_colours_of_a_telephone_become_srgb(tmp_path: Path, heard: Heard, orientation: int) -> None:
    folder = three(tmp_path / "in")
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.new("RGB", SIZE, IN_P3).save(folder / "p3.jpg", quality=95, exif=exif, icc_profile=p3_profile())
    pixels = read_photograph(found(folder, heard)["p3.jpg"])
    assert pixels.shape[:2] == (SIZE if orientation == 6 else SIZE[::-1])
    np.testing.assert_allclose(pixels.reshape(-1, 3).mean(axis=0), IN_SRGB, atol=4)


def test_photographs_are_reduced_and_the_focal_length_with_them(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    picture(9, (800, 600)).save(folder / "large.jpg", exif=exif)
    photograph = found(folder, heard, max_size=400)["large.jpg"]
    assert (photograph.width, photograph.height) == (400, 300)
    assert photograph.focal == pytest.approx(26 / 43.2666 * 500, rel=1e-3)
    assert read_photograph(photograph).shape == (300, 400, 3)
    photograph.path.unlink()
    with pytest.raises(InputError, match=r"large\.jpg does not exist"):
        read_photograph(photograph)
    assert found(folder, heard)["0.png"].focal is None


def test_devices_are_distinguished(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    for seed, model in enumerate(("one", "one", "other"), start=5):
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = model
        picture(seed).save(folder / f"{seed}.jpg", exif=exif)
    shots = found(folder, heard)
    assert shots["5.jpg"].device == shots["6.jpg"].device != shots["7.jpg"].device


def test_digital_zoom_is_another_lens(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    for seed, focal in enumerate((26, 26, 52), start=5):
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = "telephone"
        tags = exif.get_ifd(ExifTags.IFD.Exif)
        tags[ExifTags.Base.FocalLength], tags[ExifTags.Base.LensModel] = 5.96, "back camera 5.96mm f/1.6"
        tags[ExifTags.Base.FocalLengthIn35mmFilm] = focal
        picture(seed).save(folder / f"{seed}.jpg", exif=exif)
    keys = {name: _camera_key(shot) for name, shot in found(folder, heard).items()}
    assert keys["5.jpg"] == keys["6.jpg"] != keys["7.jpg"]


def test_numbers_are_sorted_by_value_and_folders_stay(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    three(folder / "left")
    for seed, name in enumerate(("10.png", "9.png", "left/10.png"), start=20):
        picture(seed).save(folder / name)
    (folder / ".hidden.png").write_text("no picture")
    (folder / "notes.txt").write_text("about them")
    for path in sorted(folder.glob("left/?.png")):
        picture(40 + int(path.stem)).save(path)
    names = [one.name for one in photographs_in(folder, 1600, heard)]
    flat = ["0.jpg", "1.jpg", "2.jpg", "9.jpg", "10.jpg"]
    assert names == [*flat, "left/0.jpg", "left/1.jpg", "left/2.jpg", "left/10.jpg"]


def test_masks_next_to_photographs_are_not_taken_for_photographs(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    for seed, name in enumerate(("1_mask.jpg", "2_mask.png", "wall_mask.png"), start=5):
        picture(seed).save(folder / name)
    for name in ("masks/0.png", "left/ignore/0.png", "panes/1.png"):
        (folder / name).parent.mkdir(parents=True)
        picture(9).save(folder / name)
    assert sorted(found(folder, heard)) == ["0.png", "1.png", "2.png", "wall_mask.png"]
    (note,) = notes_of(heard)
    names = "1_mask.jpg, 2_mask.png, left/ignore/0.png, masks/0.png, panes/1.png"
    assert note.startswith(f"Skipped masks, recognised by their names or folders: {names}. They are not copied")


def test_the_names_of_parent_folders_do_not_matter(tmp_path: Path, heard: Heard) -> None:
    assert len(found(three(tmp_path / "masks" / "panes"), heard)) == 3
    assert not notes_of(heard)


def test_folders_may_be_links(tmp_path: Path, heard: Heard) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "left").symlink_to(three(tmp_path / "elsewhere"))
    assert [one.name for one in photographs_in(tmp_path / "in", 1600, heard)] == [f"left/{n}.jpg" for n in range(3)]


def test_names_differ_without_suffix_too(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.jpg", "a.png", "b.tif", "c\n.jpg", "B.tif")]
    names = capture_names(paths, tmp_path)
    stems = {Path(name).stem.casefold() for name in names.values()}
    assert len(stems) == len(paths)
    assert all(name.endswith(".jpg") and "\n" not in name for name in names.values())


def test_names_that_are_not_unicode_can_be_written(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    for seed, name in enumerate((b"caf\xe9.png", b"caf\xea.png"), start=7):
        picture(seed).save(tmp_path / "x.png")
        os.rename(tmp_path / "x.png", os.path.join(os.fsencode(folder), name))
    names = [one.name for one in photographs_in(folder, 1600, heard)]
    assert len({name.encode() for name in names}) == 5


def test_the_same_photograph_counts_once(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    (folder / "copy.png").write_bytes((folder / "1.png").read_bytes())
    assert sorted(found(folder, heard)) == ["0.png", "1.png", "2.png"]
    assert notes_of(heard) == ["Skipped duplicates: copy.png (as 1.png)."]


def test_duplicate_photographs_keep_the_shorter_name(tmp_path: Path, heard: Heard) -> None:
    folder = three(tmp_path / "in")
    for name in ("IMG 9 copy 2.png", "IMG 9 copy.png", "IMG 9.png", "IMG 8.png"):
        picture(9 - (name == "IMG 8.png")).save(folder / name)
    names = list(found(folder, heard))
    assert names == ["0.png", "1.png", "2.png", "IMG 8.png", "IMG 9.png"]
    twins = "IMG 9 copy 2.png (as IMG 9.png), IMG 9 copy.png (as IMG 9.png)"
    assert notes_of(heard) == [f"Skipped duplicates: {twins}."]


def broken(folder: Path) -> None:
    data = (folder / "1.png").read_bytes()
    (folder / "1.png").write_bytes(data[: len(data) // 2])


def no_picture(folder: Path) -> None:
    (folder / "1.png").write_text("<html>not found</html>")


def several(folder: Path) -> None:
    broken(folder)
    (folder / "2.png").write_bytes(b"")


def tiny(folder: Path) -> None:
    picture(5, (30, 20)).save(folder / "thumbnail.png")


def heic(folder: Path) -> None:
    (folder / "IMG_1.HEIC").write_bytes(b"....ftypheic")


def heic_by_another_name(folder: Path) -> None:
    (folder / "IMG_2.jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")


def too_few(folder: Path) -> None:
    (folder / "1.png").unlink()


def only_twins(folder: Path) -> None:
    for name in ("1.png", "2.png"):
        (folder / name).write_bytes((folder / "0.png").read_bytes())


def nothing(folder: Path) -> None:
    for path in list(folder.iterdir()):
        path.unlink()
    (folder / "notes.txt").write_text("")


def a_capture(folder: Path) -> None:
    (folder / "images").mkdir()
    (folder / "panes").mkdir()
    (folder / "panes" / "0.png").write_bytes((folder / "0.png").read_bytes())


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (a_capture, r"in is a capture; expected a folder of photographs, such as .*images"),
        (broken, r"cannot read .*1\.png as an image"),
        (several, r"2 of 3 photographs cannot be used \(1\.png, 2\.png\).*The first: cannot read .*1\.png as"),
        (no_picture, r"cannot read .*1\.png as an image"),
        (tiny, r"thumbnail\.png is 30x20 pixels; expected a photograph of at least 64"),
        (heic, r"in holds HEIC files.*IMG_1\.HEIC.*save them as JPEG.*pip install 'glassplat\[heic\]'"),
        (heic_by_another_name, r"in holds HEIC files.*IMG_2\.jpg.*save them as JPEG"),
        (too_few, r"holds too few photographs: 2; expected at least 3"),
        (only_twins, r"too few photographs: 1, and duplicates of them \(1\.png \(as 0\.png\), 2\.png \(as 0\.png\)\)"),
        (nothing, r"no photograph in .*found notes\.txt"),
    ],
)
def test_what_cannot_be_used_is_named(
    spoil: object, expected: str, tmp_path: Path, heard: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("glassplat.files.images.can_read_heif", lambda: False)
    folder = three(tmp_path / "in")
    spoil(folder)  # type: ignore[operator]
    with pytest.raises(InputError, match=expected):
        photographs_in(folder, 1600, heard)


@pytest.mark.parametrize("reads", [False, True])
def test_heic_is_expected_where_it_can_be_read(
    reads: bool, tmp_path: Path, heard: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("glassplat.files.images.can_read_heif", lambda: reads)
    with pytest.raises(InputError) as refused:
        photographs_in(tmp_path, 1600, heard)
    assert (".tiff, .heic, .heif files" in str(refused.value)) == reads


def test_photographs_of_a_telephone_are_read_upright_under_any_name(tmp_path: Path, heard: Heard) -> None:
    pytest.importorskip("pi_heif")
    folder = three(tmp_path / "in")
    for name in ("IMG_1.HEIC", "IMG_2.jpg"):
        # One byte after the end makes them two photographs.
        (folder / name).write_bytes(TELEPHONE.read_bytes() + name[4:5].encode())
    seen = found(folder, heard)
    assert sorted(seen) == ["0.png", "1.png", "2.png", "IMG_1.HEIC", "IMG_2.jpg"]
    for name in ("IMG_1.HEIC", "IMG_2.jpg"):
        photograph = seen[name]
        assert (photograph.width, photograph.height, photograph.device) == (72, 96, "Maker Telephone 26")
        assert photograph.focal == pytest.approx(26 / np.hypot(36, 24) * np.hypot(72, 96))
        pixels = read_photograph(photograph).astype(int)
        np.testing.assert_allclose(pixels[2, -3], (0, 255, 80), atol=12)
        np.testing.assert_allclose(pixels[:, 2], 250, atol=12)
