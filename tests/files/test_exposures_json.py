from pathlib import Path

import pytest
import torch

from glassplat.files.sidecars import read_corrections, write_corrections
from glassplat.scene.corrections import Exposures


def test_written_files_are_read(tmp_path: Path) -> None:
    affine = torch.randn(3, 3, 4, generator=torch.Generator().manual_seed(0))
    write_corrections(tmp_path / "exposures.json", Exposures(affine, ("a.png", "b/c.png", "ü.png")))
    found = read_corrections(tmp_path / "exposures.json", Exposures)
    assert found.names == ("a.png", "b/c.png", "ü.png")
    assert torch.equal(found.values, affine)


@pytest.mark.parametrize(
    "text", ["[]", '{"a": 3}', '{"a": [[1, 2, 3, 4]]}', '{"a": [[1,2,3,NaN],[1,2,3,4],[1,2,3,4]]}']
)
def test_a_foreign_file_is_an_error_that_names_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "exposures.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"exposures\.json"):
        read_corrections(path, Exposures)
