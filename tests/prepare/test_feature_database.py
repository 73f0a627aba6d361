"""Damaged databases of features: an interrupted preparation that continues from one reports it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from glassplat.errors import InputError
from glassplat.prepare.colmap import FeatureDatabase, FeatureOptions, check_database
from glassplat.prepare.photographs import Photograph


def features(folder: Path, count: int = 3) -> FeatureDatabase:
    photographs = [Photograph(Path(f"{index}.png"), f"{index}.png", 64, 48, "", None) for index in range(count)]
    found = FeatureDatabase(folder / "features.db", folder, photographs)
    found.create("opencv")
    return found


@pytest.mark.parametrize("kept", [0.5, 0.1])
def test_a_database_that_is_cut_off_is_named(tmp_path: Path, kept: float) -> None:
    database = features(tmp_path)
    data = database.path.read_bytes()
    database.path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=r"features\.db is damaged, .* --force"):
        database.feature_counts()


def test_a_missing_name_counts_as_damage(tmp_path: Path) -> None:
    database = features(tmp_path)
    script = f"""
import sqlite3
tables = sqlite3.connect({str(database.path)!r})
tables.execute("PRAGMA writable_schema = 1")
tables.execute("UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', '')")
tables.commit()
tables.close()
tables = sqlite3.connect({str(database.path)!r})
tables.execute("UPDATE images SET name = NULL")
tables.commit()
"""
    subprocess.run([sys.executable, "-c", script], check=True)  # Its SQLite must not meet COLMAP's in one process.
    with pytest.raises(InputError, match="damaged"):
        database.feature_counts()


def test_a_partial_image_of_a_killed_command_is_ignored(tmp_path: Path) -> None:
    """A temporary file left in the folder by `kill -9`, complete or truncated."""
    photographs = []
    for number in range(2):
        path = tmp_path / f"{number}.png"
        noise = np.random.default_rng(number).integers(0, 255, (12, 16), np.uint8)
        Image.fromarray(noise).resize((160, 120), Image.Resampling.BICUBIC).save(path)
        photographs.append(Photograph(path, path.name, 160, 120, "", None))
    database = FeatureDatabase(tmp_path / "features.db", tmp_path / "grey", photographs)
    database.write_images(lambda message: None)
    whole = (tmp_path / "grey" / "000000.png").read_bytes()
    for name, data in ((".000002.0a.tmp.png", whole), (".000003.0b.tmp.png", whole[: len(whole) // 2])):
        (tmp_path / "grey" / name).write_bytes(data)
    database.create("simple_radial")
    database.extract(FeatureOptions(500, 0.0067), lambda message: None)
    counts = database.feature_counts()
    assert len(counts) == 2 and (counts > 0).all()


def test_a_full_disk_and_other_errors_keep_their_types(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space left"), check_database(tmp_path):
        raise RuntimeError("SQLite error: database or disk is full")
    with pytest.raises(RuntimeError, match="of another kind"), check_database(tmp_path):
        raise RuntimeError("of another kind")


def test_a_full_disk_does_not_end_the_process(tmp_path: Path) -> None:
    script = f"""
import resource, signal
from pathlib import Path
from glassplat.errors import InputError
from tests.prepare.test_feature_database import features
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (220_000, 220_000))
try:
    features(Path({str(tmp_path)!r}), 400)
except InputError:
    print("told")
"""
    ended = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "told\n"), ended.stderr[-500:]
