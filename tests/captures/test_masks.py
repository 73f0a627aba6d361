"""Pane masks: names, values, polarity and sizes."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.captures.masks import MaskSet, find_masks, mask_paths, read_mask
from glassplat.captures.view import View
from glassplat.errors import InputError

HEIGHT, WIDTH = 24, 32
INSIDE = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
INSIDE[6:18, 8:20] = 1


def annotated(data: Dataset) -> dict[str, View]:
    return {view.name: view for view in (*data.train, *data.test) if view.pane_labels is not None}


def labels_of(data: Dataset, name: str = "0001.png") -> np.ndarray:
    labels = annotated(data)[name].pane_labels
    assert labels is not None
    assert labels.dtype == torch.uint8
    return labels.numpy()


@pytest.mark.parametrize(
    "path",
    [
        "panes/0001.png",
        "panes/0001.png.png",
        "panes/0001.tif",
        "panes/0001_mask.png",
        "panes/0001.png_mask.bmp",
    ],
)
def test_every_naming_is_found(capture, path: str) -> None:
    capture.write_colmap()
    capture.write_mask(path, INSIDE)
    data = load_dataset(capture.root)
    np.testing.assert_array_equal(labels_of(data), INSIDE)
    assert list(annotated(data)) == ["0001.png"]
    assert data.pane_labels == (1,)
    assert data.warnings == ()


def test_masks_of_nested_photographs(capture) -> None:
    capture.names = [f"cam{index % 2}/{index // 2}.png" for index in range(10)]
    capture.write_colmap()
    capture.write_mask("panes/cam0/1.png", INSIDE)
    capture.write_mask("panes/cam1/1.png", INSIDE * 2)
    data = load_dataset(capture.root)
    assert list(annotated(data)) == ["cam0/1.png", "cam1/1.png"]
    assert data.pane_labels == (1, 2)
    capture.write_mask("panes/2.png", INSIDE)
    with pytest.raises(InputError, match=r"could belong to cam0/2\.png, cam1/2\.png"):
        load_dataset(capture.root)


def test_folder_may_be_left_out_where_the_name_is_unique(capture) -> None:
    capture.names = [f"cam{index % 2}/{index}.png" for index in range(10)]
    capture.write_colmap()
    capture.write_mask("panes/3.png", INSIDE)
    assert list(annotated(load_dataset(capture.root))) == ["cam1/3.png"]


def masks_of(root: Path, masks: list[str], photographs: list[str]) -> dict[str, str]:
    """Name in `panes/` of the mask found for each photograph, given the names of masks and photographs."""
    for mask in masks:
        path = root / "panes" / mask
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(INSIDE).save(path)
    found, _ = find_masks(root, {name: root / name for name in photographs})
    return {name: mask.path.relative_to(root / "panes").as_posix() for name, mask in found.masks.items()}


@pytest.mark.parametrize(
    ("mask", "photographs", "owner"),
    [
        ("1.png", ["1.jpg", "a/1.jpg"], "1.jpg"),
        ("1.jpg.png", ["1.jpg", "a/1.jpg"], "1.jpg"),
        ("a/1.png", ["1.jpg", "a/1.jpg"], "a/1.jpg"),
        ("a.jpg.png", ["a.jpg", "a.png"], "a.jpg"),
        ("a.png.png", ["a.jpg", "a.png"], "a.png"),
        ("a.png", ["a.jpg", "a.png"], "a.png"),
        ("a.jpg_mask.png", ["a.jpg", "a.png"], "a.jpg"),
        ("1_mask.png", ["1.jpg", "a/1.jpg"], "1.jpg"),
        ("1.jpg.png", ["/x/1.jpg", "1.jpg"], "1.jpg"),
        ("1.png", ["1.jpg", "1.png.jpg"], "1.jpg"),
        ("left/1.png", ["/x/left/1.jpg", "/x/right/1.jpg"], "/x/left/1.jpg"),
    ],
)
def test_an_exact_name_is_preferred(tmp_path: Path, mask: str, photographs: list[str], owner: str) -> None:
    assert masks_of(tmp_path, [mask], photographs) == {owner: mask}


@pytest.mark.parametrize(
    "photographs",
    [
        ["a.jpg", "a.png", "A.jpg", "b/a.jpg", "b/a.tif"],
        ["../x/a.png", "a.png", "/y/a.png", "../x/b/a.png"],
        ["1.jpg", "1.webp", "1.jpg.png", "1.jpg.tif"],
        ["1.jpg", "1.jpg.webp", "1.png.jpg"],
        ["wall.jpg", "wall_mask.jpg", "a/wall.jpg", "a/wall_mask.png"],
    ],
)
def test_every_photograph_has_a_mask_of_its_own(tmp_path: Path, photographs: list[str]) -> None:
    expected = {name: path.as_posix() for name, path in mask_paths(photographs).items()}
    assert sorted(expected) == sorted(photographs)
    assert masks_of(tmp_path, list(expected.values()), photographs) == expected


@pytest.mark.parametrize("folder", ["panes", "masks", "ignore"])
def test_hidden_folders_are_left_out(capture, folder: str) -> None:
    capture.write_colmap()
    capture.write_mask(f"{folder}/0001.png", INSIDE * 255)
    capture.write_mask(f"{folder}/.ipynb_checkpoints/0001-checkpoint.png", INSIDE * 255)
    capture.write_mask(f"{folder}/left/.thumbnails/0001.png", INSIDE * 255)
    (capture.root / folder / ".#0001.png").symlink_to("/nowhere")
    assert load_dataset(capture.root).warnings == ()


def test_masks_in_a_linked_folder_are_found(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    Image.fromarray(INSIDE).save(tmp_path / "elsewhere" / "1.png")
    (tmp_path / "panes").mkdir()
    (tmp_path / "panes" / "left").symlink_to(tmp_path / "elsewhere")
    assert masks_of(tmp_path, ["2.png"], ["left/1.jpg", "2.jpg"]) == {"left/1.jpg": "left/1.png", "2.jpg": "2.png"}


def test_masks_of_hidden_photographs_are_ignored(tmp_path: Path) -> None:
    assert masks_of(tmp_path, [".cam/1.png", ".cam/2-checkpoint.png"], [".cam/1.jpg", "2.jpg"]) == {
        ".cam/1.jpg": ".cam/1.png"
    }


def test_a_photograph_is_not_taken_for_a_mask_of_another(capture) -> None:
    capture.names[:3] = ["wall.png", "wall_mask.png", "door.png"]
    capture.write_colmap()
    capture.write_mask("images/door_mask.png", INSIDE * 255)
    data = load_dataset(capture.root)
    ignored = {view.name: view.ignored for view in (*data.train, *data.test) if view.ignored is not None}
    assert list(ignored) == ["door.png"]
    np.testing.assert_array_equal(ignored["door.png"].numpy() == 0, INSIDE == 1)


def test_an_ambiguous_photograph_name_is_refused_with_an_unambiguous_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"could belong to a\.jpg, a\.png; call it a\.jpg\.png, or after another"):
        masks_of(tmp_path, ["a.tif"], ["a.jpg", "a.png"])


def test_labels_of_several_panes_stay(capture) -> None:
    capture.write_colmap()
    panes = INSIDE.copy()
    panes[6:12, 8:20] = 7
    capture.write_mask("panes/0001.png", panes)
    capture.write_mask("panes/0002.png", INSIDE * 3)
    data = load_dataset(capture.root)
    assert data.pane_labels == (1, 3, 7)
    np.testing.assert_array_equal(labels_of(data), panes)


def test_colour_table_keeps_labels(capture) -> None:
    capture.write_colmap()
    image = Image.new("P", (WIDTH, HEIGHT))
    image.putpalette([0, 0, 0, 200, 10, 10, 10, 200, 10])
    image.paste(2, (8, 6, 20, 18))
    (capture.root / "panes").mkdir()
    image.save(capture.root / "panes" / "0001.png")
    np.testing.assert_array_equal(labels_of(load_dataset(capture.root)), INSIDE * 2)


def black_and(color: tuple[int, int, int]) -> Image.Image:
    """An image with one colour inside, on black."""
    return Image.fromarray(INSIDE[:, :, None] * np.array(color, dtype=np.uint8))


def in_palette(*colors: tuple[int, int, int]) -> Image.Image:
    """The last colour inside, the first outside; further ones in the corner."""
    image = Image.new("P", (WIDTH, HEIGHT))
    image.putpalette([value for color in colors for value in color])
    image.paste(len(colors) - 1, (8, 6, 20, 18))
    for index in range(1, len(colors) - 1):
        image.putpixel((index, 0), index)
    return image


def opaque_inside(color: tuple[int, int, int] = (0, 90, 0)) -> Image.Image:
    """The same colour everywhere, transparent outside."""
    image = Image.new("RGB", (WIDTH, HEIGHT), color)
    image.putalpha(Image.fromarray(INSIDE * 255))
    return image


WAYS = {
    "grey": (Image.fromarray(INSIDE * 255), {}),
    "white": (black_and((255, 255, 255)).quantize(2), {}),
    "red": (black_and((255, 0, 0)), {}),
    "quantized": (black_and((255, 0, 0)).quantize(2), {}),
    "adaptive": (black_and((255, 0, 0)).convert("P", palette=Image.Palette.ADAPTIVE, colors=2), {}),
    "red at 0": (ImageOps.invert(Image.fromarray(INSIDE * 255)).convert("P"), {}),
    "transparent": (opaque_inside(), {}),
    "transparent grey": (opaque_inside().convert("LA"), {}),
    "transparent grey value": (Image.fromarray(INSIDE * 9), {"transparency": 0}),
    "transparent palette": (opaque_inside().quantize(4), {}),
    "transparent index": (in_palette((9, 9, 9), (200, 0, 0)), {"transparency": bytes([0, 255])}),
    "opaque": (black_and((255, 255, 255)).convert("RGBA"), {}),
    "one bit": (Image.fromarray(INSIDE > 0), {}),
    "sixteen bit": (Image.fromarray(INSIDE.astype(np.uint16) * 65535), {}),
    "white at 0": (ImageOps.invert(Image.fromarray(INSIDE * 255)).convert("P"), {}),
    "jpeg": (Image.fromarray(INSIDE * 255), {}),
    "half transparent": (in_palette((0, 0, 0), (255, 255, 255)), {"transparency": bytes([0, 128])}),
}
WAYS["red at 0"][0].putpalette([255, 0, 0] + 255 * [0, 0, 0])
WAYS["white at 0"][0].putpalette([255, 255, 255] + 255 * [0, 0, 0])


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("folder", ["panes", "ignore", "masks"])
def test_every_way_to_store_a_mask_reads_the_same(capture, folder: str, way: str) -> None:
    capture.write_colmap()
    (capture.root / folder).mkdir()
    image, options = WAYS[way]
    image.save(capture.root / folder / ("0001.jpg" if way == "jpeg" else "0001.png"), **options)
    data = load_dataset(capture.root)
    if folder == "panes":
        np.testing.assert_array_equal(labels_of(data), INSIDE)
        return
    view = next(view for view in (*data.train, *data.test) if view.ignored is not None)
    np.testing.assert_array_equal(view.ignored, INSIDE if folder == "ignore" else 1 - INSIDE)


def test_greys_of_a_palette_are_shades(capture) -> None:
    capture.write_colmap()
    shades = np.array(in_palette((255,) * 3, *((shade,) * 3 for shade in range(250, 0, -50)), (0, 0, 0)).convert("L"))
    (capture.root / "panes").mkdir()
    Image.fromarray(shades).convert("RGB").quantize(16).save(capture.root / "panes" / "0001.png")
    np.testing.assert_array_equal(labels_of(load_dataset(capture.root, mask_polarity="bright")), shades >= 128)


def test_a_palette_whose_entry_0_is_not_black_is_refused(capture) -> None:
    capture.write_colmap()
    (capture.root / "panes").mkdir()
    in_palette((200, 0, 0), (0, 200, 0), (0, 0, 0)).save(capture.root / "panes" / "0001.png")
    with pytest.raises(InputError, match=r"0001\.png has a palette in which 0, no pane, is a colour; expected black"):
        load_dataset(capture.root)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.full((HEIGHT, WIDTH), np.nan, dtype=np.float32), "floating-point numbers"),
        (INSIDE.astype(np.float32), "floating-point numbers"),
        (INSIDE.astype(np.int32) * 300, "holds the value 300, which is neither a pane label"),
        (INSIDE.astype(np.uint16) * 16000, "holds the value 16000, which is neither a pane label"),
        (INSIDE.astype(np.int32) * -1, "values from -1 to 0"),
        (INSIDE.astype(np.int32) * 10**6, "values from 0 to 1000000"),
    ],
)
def test_values_that_are_neither_labels_nor_white_are_refused(capture, pixels: np.ndarray, message: str) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.tif", pixels)
    with pytest.raises(InputError, match=message) as caught:
        load_dataset(capture.root)
    assert "0001.tif" in str(caught.value)


@pytest.mark.parametrize("name", ["panes", "panes/0001.png", "masks", "masks/0001.png"])
def test_a_broken_link_is_named(capture, name: str) -> None:
    capture.write_colmap()
    (capture.root / name).parent.mkdir(exist_ok=True)
    (capture.root / name).symlink_to("/nowhere")
    with pytest.raises(InputError, match=f"{name} is not a readable f"):
        load_dataset(capture.root)


def test_a_mask_of_one_pixel_is_not_taken_for_a_reduced_mask(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", np.ones((1, 1), dtype=np.uint8))
    with pytest.raises(InputError, match="is 1x1 pixels, its photograph 32x24"):
        load_dataset(capture.root)


@pytest.mark.parametrize("pixels", [INSIDE.astype(np.uint16) * 3, INSIDE.astype(np.uint16) * 3 * 257])
def test_labels_may_be_stored_in_sixteen_bits(capture, pixels: np.ndarray) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", pixels)
    np.testing.assert_array_equal(labels_of(load_dataset(capture.root)), INSIDE * 3)


def test_soft_edges_are_cut_at_the_middle(capture) -> None:
    capture.write_colmap()
    soft = (INSIDE * 255).astype(np.uint8)
    soft[6, 8:20] = np.linspace(40, 250, 12).astype(np.uint8)
    capture.write_mask("panes/0001.png", soft)
    np.testing.assert_array_equal(labels_of(load_dataset(capture.root)), (soft >= 128).astype(np.uint8))


@pytest.mark.parametrize("values", [{1: 1, 2: 255}, {1: 100, 2: 100}, {1: 128, 2: 255}])
def test_ambiguous_values_are_refused(capture, values: dict[int, int]) -> None:
    capture.write_colmap()
    pixels = np.where(INSIDE > 0, values[1], 0).astype(np.uint8)
    pixels[6:8, 8:20] = values[2]
    path = capture.write_mask("panes/0001.png", pixels)
    with pytest.raises(InputError, match=rf"{path} holds the grey values 0, .*neither pane labels"):
        load_dataset(capture.root)


def test_photograph_as_a_mask_is_refused(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint8))
    with pytest.raises(InputError, match="neither pane labels"):
        load_dataset(capture.root)


def test_several_colours_are_refused(capture) -> None:
    capture.write_colmap()
    pixels = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    pixels[:5, :5, 0] = pixels[10:, 10:, 1] = 255
    capture.write_mask("panes/0001.png", pixels)
    with pytest.raises(InputError, match="several colours"):
        load_dataset(capture.root)


def test_a_mask_in_colour_takes_little_memory(tmp_path: Path) -> None:
    Image.new("RGB", (2048, 1024), (255, 0, 0)).save(tmp_path / "a.png")
    read_mask(tmp_path / "a.png")
    tracemalloc.start()
    read_mask(tmp_path / "a.png")
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 16 * 2048 * 1024, "bytes a pixel, of arrays of ours; Pillow's own are not counted"


def test_labels_mixed_with_black_and_white_are_refused(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", INSIDE)
    capture.write_mask("panes/0002.png", INSIDE * 255)
    with pytest.raises(InputError, match="some masks are label images"):
        load_dataset(capture.root)


def test_inverted_masks_are_recognised_by_their_border(capture) -> None:
    capture.write_colmap()
    for name in ("0001.png", "0002.png", "0003.png"):
        capture.write_mask(f"panes/{name}", (1 - INSIDE) * 255)
    data = load_dataset(capture.root)
    np.testing.assert_array_equal(labels_of(data), INSIDE)
    assert any("inverted" in warning for warning in data.warnings)
    stated = load_dataset(capture.root, mask_polarity="bright")
    np.testing.assert_array_equal(labels_of(stated), 1 - INSIDE)


def test_masks_of_one_bit_have_a_polarity_next_to_those_of_eight(capture) -> None:
    capture.write_colmap()
    outside = INSIDE == 0
    capture.write_mask("panes/0001.png", outside)
    capture.write_mask("panes/0002.png", outside.astype(np.uint8) * 255)
    for polarity, expected in (("auto", INSIDE), ("dark", INSIDE), ("bright", 1 - INSIDE)):
        data = load_dataset(capture.root, mask_polarity=polarity)
        for name in ("0001.png", "0002.png"):
            np.testing.assert_array_equal(labels_of(data, name), expected)


def test_stated_polarity_does_not_apply_to_label_images(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", INSIDE)
    data = load_dataset(capture.root, mask_polarity="dark")
    np.testing.assert_array_equal(labels_of(data), INSIDE)


def test_panes_that_fill_the_image_are_not_inverted(capture) -> None:
    capture.write_colmap()
    for name in ("0001.png", "0002.png", "0003.png"):
        capture.write_mask(f"panes/{name}", np.full((HEIGHT, WIDTH), 255, dtype=np.uint8))
    data = load_dataset(capture.root)
    assert labels_of(data).min() == 1
    assert any("cover 100%" in warning for warning in data.warnings)


def test_view_without_a_pane_is_mentioned(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", INSIDE * 255)
    capture.write_mask("panes/0002.png", INSIDE * 0)
    data = load_dataset(capture.root)
    assert labels_of(data, "0002.png").max() == 0
    assert any("0002.png" in warning for warning in data.warnings)


@pytest.mark.parametrize(
    ("path", "pixels", "message"),
    [
        ("panes/0001.png", INSIDE * 0, "no mask of .* marks a pane"),
        ("panes/other.png", INSIDE, r"masks in .* match no photograph: other\.png; .* such as 0000\.png"),
        ("panes/0001.png", INSIDE[:20], r"panes/0001\.png is 32x20 pixels, its photograph 32x24"),
        ("panes/readme.txt", None, "holds no mask images"),
        ("panes/0001.png", None, "as an image"),
    ],
)
def test_masks_that_cannot_be_used(capture, path: str, pixels: np.ndarray | None, message: str) -> None:
    capture.write_colmap()
    target = capture.root / path
    target.parent.mkdir()
    if pixels is None:
        target.write_text("no image")
    else:
        Image.fromarray(pixels).save(target)
    with pytest.raises(InputError, match=message):
        load_dataset(capture.root)


def test_two_masks_for_one_photograph_are_refused(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", INSIDE)
    capture.write_mask("panes/0001.png.png", INSIDE)
    with pytest.raises(InputError, match=r"0001\.png has 2 masks"):
        load_dataset(capture.root)


@pytest.mark.parametrize("factor", [2, 3])
def test_integer_scaled_masks_take_the_nearest_pixel(capture, factor: int) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", np.kron(INSIDE, np.ones((factor, factor), dtype=np.uint8)))
    np.testing.assert_array_equal(labels_of(load_dataset(capture.root)), INSIDE)


def test_half_size_mask_covers_the_same_area(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", INSIDE[::2, ::2])
    np.testing.assert_array_equal(labels_of(load_dataset(capture.root)), INSIDE)


def test_downscaling_keeps_labels_pure(capture) -> None:
    capture.write_colmap()
    capture.write_mask("panes/0001.png", INSIDE * 5)
    labels = labels_of(load_dataset(capture.root, downscale=2.0))
    np.testing.assert_array_equal(labels, INSIDE[1::2, 1::2] * 5)


def test_no_masks_at_all(capture, tmp_path: Path) -> None:
    capture.write_colmap()
    data = load_dataset(capture.root)
    assert not annotated(data)
    assert data.pane_labels == ()
    assert find_masks(tmp_path / "nowhere", {}) == (MaskSet({}), {})
