"""The trial: its cases follow from the seed, and failures are counted as faults."""

from __future__ import annotations

import itertools
import random
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tools import reader_seeds, trial, trial_readers
from tools.reader_seeds import READERS, Reader
from tools.trial import CLASSES, Case, tried
from tools.trial_numbers import fault_of, picture
from tools.trial_process import Ended, Sent, run


@pytest.mark.parametrize("name", CLASSES)
def test_every_class_has_cases(name: str) -> None:
    assert callable(trial.trial_of(name))


def test_faults_are_printed_and_counted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def cases(seed: int, cases: int, place: Path) -> Iterator[Case]:
        assert place.is_dir() and not list(place.iterdir())
        yield from (Case(str(number), "broken" if number == seed else "") for number in range(cases))

    monkeypatch.setattr(trial, "trial_of", lambda name: cases)
    assert tried("readers", 3, 5, minutes=1) == (5, [Case("3", "broken")])
    assert capsys.readouterr().out == "FAULT 3: broken\n"
    assert tried("readers", 3, 5, minutes=0)[0] == 1


def test_damaged_files_follow_from_the_seed_and_are_refused_with_a_message(tmp_path: Path) -> None:
    found = []
    for place in (tmp_path / "a", tmp_path / "b"):
        place.mkdir()
        found.append(list(trial_readers.tried("exposures", 1, 40, place)))
    assert found[0] == found[1] and len(found[0]) == 40
    assert not [case for case in found[0] if case.fault]


def test_a_crashing_reader_counts_as_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(path: Path) -> None:
        raise TypeError("not foreseen")

    monkeypatch.setattr(reader_seeds, "READERS", {"bad": Reader("a", read, READERS["exposures"].seeds)})
    monkeypatch.setattr(trial_readers, "ROOT", tmp_path)
    (case,) = trial_readers.tried("bad", 1, 1, tmp_path)
    assert case.fault.startswith("TypeError: not foreseen (") and list((tmp_path / "runs" / "trial").iterdir())


def test_what_is_a_bad_end() -> None:
    assert not Ended(0, "").fault() and not Ended(2, "error: no such folder").fault() and not Ended(None, "").fault()
    assert Ended(2, " ").fault() and Ended(-11, "x").fault() and Ended(None, "", is_late=True).fault()
    assert Ended(1, "Traceback (most recent call last):").fault()


def test_a_command_is_run_and_killed() -> None:
    assert run(["--version"]).output.startswith("glassplat ")
    assert run(["--help"], sent=Sent(signal.SIGKILL, 0.0)).code is None


def test_invalid_values_give_a_finite_image_or_an_error() -> None:
    whats = []
    for number in itertools.count():
        what, work = picture(random.Random(f"0 {number}"))
        if what.startswith(("Splat", "Planar")) and "crowd" not in what:
            assert not fault_of(work), what
            whats.append(what)
        if len(whats) == 8:
            return
