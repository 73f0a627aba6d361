"""Errors of normals are put into the band of what the true surface mirrors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from glassplat.captures.dataset import load_dataset
from glassplat.evaluate.truth import true_surface
from glassplat.render.deferred import view_directions
from tools.normal_errors import errors_by_band, mirrored_rays

BALL = Path(__file__).parent.parent / "data_files" / "ball"


def test_a_ball_mirrors_the_camera_where_it_faces_it_and_lets_rays_pass_at_its_rim() -> None:
    view = load_dataset(BALL).test[0]
    truth = true_surface(view)
    assert truth is not None and truth.normals is not None and truth.strength is not None
    mirror = truth.strength == 1
    rays = torch.nn.functional.normalize(view_directions(view.camera), dim=-1).float()
    mirrored = mirrored_rays(view, truth.normals)
    assert torch.allclose(mirrored[mirror].norm(dim=-1), torch.tensor(1.0), atol=0.02)
    turned = (rays * mirrored).sum(dim=-1)[mirror]
    assert turned.min() < -0.99
    assert turned.max() > 0.5
    # What leaves a ball goes outwards.
    assert ((mirrored * truth.normals).sum(dim=-1)[mirror] > -1e-2).all()


def test_each_pixel_counts_in_its_band_alone() -> None:
    upward = torch.tensor([-0.9, -0.6, -0.1, 0.0, 0.2, 0.4, 0.8])
    errors = torch.tensor([20.0, 10.0, 5.0, 1.0, 2.0, 3.0, 0.5])
    means, shares = zip(*errors_by_band(upward, errors), strict=True)
    assert means == pytest.approx([15.0, 5.0, 2.0, 0.5])
    assert shares == pytest.approx([2 / 7, 1 / 7, 3 / 7, 1 / 7])
