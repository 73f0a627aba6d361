import shutil
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from glassplat.files.images import read_image
from glassplat.kernels.maths.images import linear_from_srgb
from tests.training.object_capture import write_object_capture
from tests.training.tiny_capture import write_tiny_capture
from tools.spoil_capture import add_passers_by, disturb_poses, disturb_transforms, frames_of, spoil


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
    for path in ("transforms.json", "panes/1.png", "points3d.ply"):
        assert (capture / path).read_bytes() == (tmp_path / "copy" / path).read_bytes()


def test_cameras_are_perturbed_by_the_requested_amount(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    turns = Rotation.random(200, random_state=1)
    lines = ["# comment"]
    for number, (x, y, z, w) in enumerate(turns.as_quat()):
        shift = " ".join(f"{value:.9f}" for value in generator.standard_normal(3))
        lines += [f"{number + 1} {w:.9f} {x:.9f} {y:.9f} {z:.9f} {shift} 1 {number}.png", ""]
    path = tmp_path / "images.txt"
    path.write_text("\n".join(lines) + "\n")
    disturb_poses(path, 0.01, np.random.default_rng(4))
    assert (tmp_path / "true_images.txt").read_text() == "\n".join(lines) + "\n"
    disturbed = [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]
    assert [words[9] for words in disturbed] == [f"{number}.png" for number in range(200)]
    after = Rotation.from_quat([[float(words[n]) for n in (2, 3, 4, 1)] for words in disturbed])
    wobbles = (after * turns.inv()).as_rotvec()
    np.testing.assert_allclose(wobbles.std(axis=0), 0.01, rtol=0.15)


def test_passers_by_match_their_masks_and_avoid_test_views(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    shutil.copytree(capture, tmp_path / "copy")
    add_passers_by(tmp_path / "copy", 1.0, np.random.default_rng(2))
    masks = sorted(path.name for path in (tmp_path / "copy/gt/passers_by").iterdir())
    assert masks == [f"{index}.png" for index in range(1, 6)]
    for name in masks:
        before, after = (read_image(folder / "images" / name) for folder in (capture, tmp_path / "copy"))
        there = read_image(tmp_path / "copy/gt/passers_by" / name)[..., 0] > 0
        assert 0.02 < there.mean() < 0.5
        assert (before[~there] == after[~there]).all() and (before[there] != after[there]).any(axis=1).mean() > 0.9
    assert (capture / "images/0.png").read_bytes() == (tmp_path / "copy/images/0.png").read_bytes()


def test_exposure_and_pose_noise_apply_to_transforms_captures(tmp_path: Path) -> None:
    capture = write_object_capture(tmp_path / "capture")
    factors = spoil(capture, tmp_path / "copy", 0.5, 0.1, np.random.default_rng(3))
    assert len(factors) == sum(len(frames_of(capture, split)) for split in ("train", "test"))
    for name in factors:
        before, after = (read_image(folder / name) for folder in (capture, tmp_path / "copy"))
        assert (before[..., 3] == after[..., 3]).all() and (before[..., :3] != after[..., :3]).any()
    disturb_transforms(tmp_path / "copy", 0.01, np.random.default_rng(4))
    for split in ("train", "test"):
        name = f"transforms_{split}.json"
        assert (tmp_path / "copy" / f"true_{name}").read_bytes() == (capture / name).read_bytes()
        true, moved = (
            np.array([frame["transform_matrix"] for frame in frames_of(folder, split)])
            for folder in (capture, tmp_path / "copy")
        )
        wobbles = np.linalg.inv(true) @ moved
        squares = wobbles[:, :3, :3] @ wobbles[:, :3, :3].transpose(0, 2, 1)
        np.testing.assert_allclose(squares, np.broadcast_to(np.eye(3), squares.shape), atol=1e-9)
        turns = Rotation.from_matrix(wobbles[:, :3, :3]).as_rotvec()
        assert 0.003 < turns.std() < 0.03 and wobbles[:, :3, 3].std() > 0
