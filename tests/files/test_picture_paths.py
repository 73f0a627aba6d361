"""Images named after photographs, whatever the names of these."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from glassplat.files.images import flat_image_names, image_paths


def test_pictures_are_named_after_photographs() -> None:
    assert image_paths(["left/1.jpg", "2.png"]) == {"left/1.jpg": Path("left/1.png"), "2.png": Path("2.png")}
    assert len(set(image_paths(["1.jpg", "1.png", "1.tif"]).values())) == 3


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["/data/photos/1.png", "/data/photos/2.png"], ["1.png", "2.png"]),
        (["/data/left/1.jpg", "/data/right/1.jpg"], ["left/1.png", "right/1.png"]),
        (["../../other/1.jpg", "../../other/2.jpg"], ["1.png", "2.png"]),
        (["a/../../b/1.jpg", "c/2.jpg"], ["1.png", "c/2.png"]),
        (["C:\\photos\\1.jpg", "cam\\2.jpg"], ["1.png", "cam/2.png"]),
        (["\\\\server\\share\\1.jpg", "D:3.jpg"], ["1.png", "3.png"]),
        (["/x/1.jpg", "1.jpg"], ["1.jpg.png", "1.jpg-2.png"]),
        (["1.jpg", "1.png", "1.jpg.png"], ["1.jpg-2.png", "1.png.png", "1.jpg.png"]),
        (["a.jpg", "a.png/b.jpg"], ["a.jpg.png", "a.png/b.png"]),
        (["A.jpg", "a.jpg"], ["A.jpg.png", "a.jpg-2.png"]),
        (["..", "/"], ["view.png", "view-2.png"]),
    ],
)
def test_names_that_lead_elsewhere_or_to_one_file(names: list[str], expected: list[str]) -> None:
    paths = image_paths(names)
    assert list(paths) == names
    assert [path.as_posix() for path in paths.values()] == expected


PARTS = st.sampled_from(["..", ".", "a", "A", "b", "a.png", "1.jpg", "1.png", "", "C:", "C:\\x", "é", "e\u0301"])
NAMES = st.lists(st.lists(PARTS, min_size=1, max_size=4).map("/".join).filter(bool), max_size=8, unique=True)


@given(NAMES)
def test_images_stay_in_their_folder_and_never_collide(names: list[str]) -> None:
    for paths in (
        list(image_paths(names).values()),
        [Path(name) for name in flat_image_names(names).values()],
    ):
        assert all(not path.is_absolute() and ".." not in path.parts and path.suffix == ".png" for path in paths)
        plain = [path.as_posix().casefold() for path in paths]
        assert len(set(plain)) == len(names)
        folders = {folder.as_posix().casefold() for path in paths for folder in path.parents}
        assert not folders & set(plain)


def test_pictures_side_by_side_are_distinct() -> None:
    names = flat_image_names(["left/1.jpg", "left_1.png", "2.jpg"])
    assert len(set(names.values())) == 3 and names["2.jpg"] == "2.png"
    assert all("/" not in name for name in names.values())
