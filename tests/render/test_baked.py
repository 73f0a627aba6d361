"""Baked reflections: the mirror images are where and as bright as the panes show them."""

from __future__ import annotations

from dataclasses import replace

import torch

from glassplat.evaluate.metrics import psnr
from glassplat.kernels.project.reference import sh_basis
from glassplat.render.baked import baked, mean_strengths, mirrored_harmonics
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.plane_edits import as_mirrors, without_glass
from glassplat.scene.scene import Scene
from tests.train.tiny_capture import tiny_capture, true_scene

NORMAL = torch.nn.functional.normalize(torch.tensor([0.4, 0.1, -1.0], dtype=torch.float64), dim=0)


def test_harmonics_show_the_same_color_along_the_mirrored_direction() -> None:
    sh = torch.randn(5, 16, 3, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(30, 3, dtype=torch.float64), dim=1)
    mirrored = directions - 2 * (directions @ NORMAL)[:, None] * NORMAL
    for count in (1, 4, 9, 16):
        before = torch.einsum("dk,nkc->ndc", sh_basis(mirrored)[:, :count], sh[:, :count])
        after = torch.einsum("dk,nkc->ndc", sh_basis(directions)[:, :count], mirrored_harmonics(sh[:, :count], NORMAL))
        torch.testing.assert_close(after, before)


def test_a_baked_mirror_shows_what_the_mirror_shows() -> None:
    """Behind a mirror is nothing, so that nothing hides what is baked."""
    scene = as_mirrors(true_scene(), [1])
    cameras = [view.camera for view in tiny_capture().train]
    plane = scene.planes
    in_front = ((scene.primary.means - plane.centers[0]) @ plane.normals[0]) * (
        (cameras[0].center - plane.centers[0]) @ plane.normals[0]
    ) > 0
    scene = replace(scene, primary=scene.primary.select(in_front))
    assert mean_strengths(scene, Planar(), cameras)[0] > 0.1
    gaussians = baked(scene, Planar(), cameras)
    assert len(gaussians) > len(scene.primary)
    for camera in cameras:
        with torch.no_grad():
            truth = Planar()(scene, camera)
            image = Splat()(Scene(gaussians, scene.extent), camera).rgb
        hit = truth.layers["strength"] > 0.1
        bare = psnr(truth.layers["without_panes"], truth.rgb, hit)
        assert psnr(image, truth.rgb, hit) > bare + 3


def test_without_panes_nothing_is_added() -> None:
    scene = without_glass(true_scene())
    gaussians = baked(scene, Planar(), [tiny_capture().train[0].camera])
    assert torch.equal(gaussians.means, scene.primary.means)
