from pathlib import Path

import numpy as np
import torch

from glassplat.files.images import read_image
from glassplat.kernels.color_space import linear_from_srgb
from tests.train.tiny_capture import write_tiny_capture
from tools.spoil_capture import spoil


def test_photographs_differ_by_their_factors_and_nothing_else_does(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    factors = spoil(capture, tmp_path / "copy", 0.5, 0.1, np.random.default_rng(3))
    assert sorted(factors) == [f"{index}.png" for index in range(6)]
    for name, factor in factors.items():
        before, after = (
            linear_from_srgb(torch.from_numpy(read_image(folder / "images" / name).astype(np.float32)) / 255)
            for folder in (capture, tmp_path / "copy")
        )
        expected = (before * torch.from_numpy(factor).float()).clamp(0, 1)
        torch.testing.assert_close(after, expected, atol=0.01, rtol=0.05)
    assert np.std([np.log2(factor).mean() for factor in factors.values()]) > 0.1
    for path in ("transforms.json", "masks/1.png", "points3d.ply"):
        assert (capture / path).read_bytes() == (tmp_path / "copy" / path).read_bytes()
