"""JSON files from arbitrary sources."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from glassplat.files.records import DEEPEST, _dict_without_duplicates, parse_json, read_json


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not valid JSON"),
        (b'{"a": 1', "not valid JSON"),
        (b"[1,]", "not valid JSON"),
        (b"[" * 100_000 + b"]" * 100_000, f"nested more than {DEEPEST} levels deep"),
        (b"[" * (DEEPEST + 1) + b"]" * (DEEPEST + 1), f"nested more than {DEEPEST} levels deep"),
        (b'{"a":' * 100_000 + b"1" + b"}" * 100_000, f"nested more than {DEEPEST} levels deep"),
        (b'{"a": 1, "b": 2, "a": 3}', "the key 'a' occurs twice in one object"),
        (b'{"name": "\xff\xfe"}', "is not UTF-8 text"),
        ('{"name": "ü"}'.encode("utf-16"), "is not UTF-8 text"),
        (b'{"name": "\\ud800.png"}', "is not valid Unicode"),
        (b'{"\\udfff": 1}', "is not valid Unicode"),
    ],
)
def test_damage_is_named_with_the_file(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_json(tmp_path / "a.json")
    assert str(tmp_path / "a.json") in str(caught.value)


def test_a_repeated_key_among_many_is_found_in_linear_time() -> None:
    comparisons = 0

    class Key(str):
        __slots__ = ()
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            nonlocal comparisons
            comparisons += 1
            return str.__eq__(self, other)

    with pytest.raises(ValueError, match="the key '1999' occurs twice"):
        _dict_without_duplicates([(Key(key), 0) for key in (*range(2000), 1999)])
    assert comparisons < 10 * 2000


def test_byte_order_marks_and_line_ends_of_other_systems_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes('\ufeff{\r\n"a": "ü\\n",\r\n"b": [[1]]}\r\n'.encode())
    assert read_json(tmp_path / "a.json") == {"a": "ü\n", "b": [[1]]}
    nested = "[" * (DEEPEST - 1) + "1" + "]" * (DEEPEST - 1)
    assert isinstance(parse_json(nested, "a text"), list)


def test_numbers_of_any_length_are_numbers() -> None:
    largest, beyond = parse_json(f"[{2**64 - 1}, 1{'0' * 5000}]", "a text")
    assert largest == 2**64 - 1 and isinstance(largest, int)
    assert beyond == float("inf")


def test_paths_that_are_not_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"absent\.json does not exist"):
        read_json(tmp_path / "absent.json")
    os.symlink(tmp_path / "loop.json", tmp_path / "loop.json")
    (tmp_path / "folder.json").mkdir()
    os.mkfifo(tmp_path / "pipe.json")  # It has no writer: opening it would wait for ever.
    for name, reason in (
        ("folder", "a folder, a pipe or a device"),
        ("pipe", "a folder, a pipe or a device"),
        ("loop", "levels of symbolic links"),
        ("n" * 300, "too long"),
    ):
        with pytest.raises(ValueError, match=rf"{name}\.json cannot be read \(.*{reason}"):
            read_json(tmp_path / f"{name}.json")


def test_a_file_of_absurd_size_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "huge.json").touch()
    os.truncate(tmp_path / "huge.json", 2**40)  # A sparse file, which needs no space on the disk.
    with pytest.raises(ValueError, match=r"huge\.json has 1099511627776 bytes"):
        read_json(tmp_path / "huge.json")
