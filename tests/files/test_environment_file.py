from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from glassplat.files.sidecars import read_environment, write_environment
from glassplat.scene.scene import Environment


def noise(size: int = 3) -> Environment:
    return Environment.random(size, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("region", [None, (0.1, -2.0, 1e-7, 3.3)])
def test_an_environment_round_trips_bit_for_bit(
    tmp_path: Path, region: tuple[float, float, float, float] | None
) -> None:
    for raw in (noise().raw.requires_grad_(), noise(1).raw.double(), Environment.empty().raw):
        write_environment(tmp_path / "environment.safetensors", Environment(raw, region))
        read = read_environment(tmp_path / "environment.safetensors")
        assert read.region == region
        assert read.raw.dtype == raw.dtype and torch.equal(read.raw, raw)


def test_texels_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "environment.safetensors"
    for raw in (torch.full((6, 2, 2, 3), torch.nan), torch.zeros(6, 2, 2, 3, dtype=torch.int32)):
        save_file({"raw": raw}, file, metadata={"glassplat": '{"format": "glassplat-environment-1", "region": null}'})
        with pytest.raises(ValueError, match="holds no tensor `raw` of finite numbers"):
            read_environment(file)


def test_a_file_that_is_cut_off_or_foreign_is_named(tmp_path: Path) -> None:
    file = tmp_path / "environment.safetensors"
    with pytest.raises(FileNotFoundError, match="no environment at"):
        read_environment(file)
    write_environment(file, noise())
    whole = file.read_bytes()
    for contents in (whole[: len(whole) // 2], b"", b"not a safetensors file"):
        file.write_bytes(contents)
        with pytest.raises(ValueError, match="truncated or not an environment"):
            read_environment(file)
    save_file({"raw": noise().raw}, file)
    with pytest.raises(ValueError, match="has format None; expected 'glassplat-environment-1'"):
        read_environment(file)


@pytest.mark.parametrize(
    ("raw", "region", "said"),
    [
        ((6, 2, 3, 3), "null", "holds no environment: raw has shape"),
        ((6, 2, 2, 3), "[1, 2]", r"region of the header of .* is \[1, 2\]; expected a list of 4 values"),
        ((6, 2, 2, 3), '"all"', "region of the header of .* is 'all'; expected a list of 4 values"),
        ((6, 2, 2, 3), "[1, 2, 3, 1e400]", "entry 4 of region of the header of .* is inf; expected a finite number"),
    ],
)
def test_contents_that_make_no_environment_are_named(
    tmp_path: Path, raw: tuple[int, ...], region: str, said: str
) -> None:
    header = f'{{"format": "glassplat-environment-1", "region": {region}}}'
    save_file({"raw": torch.zeros(raw)}, tmp_path / "environment.safetensors", metadata={"glassplat": header})
    with pytest.raises(ValueError, match=said):
        read_environment(tmp_path / "environment.safetensors")
