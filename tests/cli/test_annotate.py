"""What `glassplat annotate` refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from glassplat.cli.main import main


def test_a_folder_that_is_no_capture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["annotate", str(tmp_path / "nothing"), "--no-open-browser"])
    said = capsys.readouterr()
    told = " ".join((said.out + said.err).split())
    assert code == 2
    assert "nothing" in told and "Traceback" not in told
