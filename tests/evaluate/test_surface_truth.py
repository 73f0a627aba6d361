"""True normals and strength next to the photographs of a capture on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import View
from glassplat.errors import InputError
from glassplat.evaluate.truth import TrueSurface, true_surface
from tests.training.object_capture import RADIUS, SIZE, seen_normals, world_from_opengl, write_object_capture

FIRST_ANGLE_RAD = 0.4


@pytest.fixture
def view(tmp_path: Path) -> View:
    return load_dataset(write_object_capture(tmp_path / "ball")).test[0]


def beside(view: View, mark: str) -> Path:
    return view.image_path.with_name(f"r_0{mark}.png")


def surface_of(view: View) -> TrueSurface:
    found = true_surface(view)
    assert found is not None
    return found


def rewritten(view: View, mark: str, mode: str) -> None:
    """Converts the file next to the photograph to another mode."""
    Image.open(beside(view, mark)).convert(mode).save(beside(view, mark))


def test_normals_are_in_world_axes_and_of_unit_length(view: View) -> None:
    surface = surface_of(view)
    normals, seen = seen_normals(world_from_opengl(FIRST_ANGLE_RAD))
    np.testing.assert_array_equal(surface.covered.numpy(), seen)
    assert surface.normals is not None
    np.testing.assert_allclose(surface.normals.numpy(), normals * seen[..., None], atol=0.01)
    torch.testing.assert_close(surface.normals.norm(dim=-1)[surface.covered], torch.ones(int(seen.sum())))
    # Visible surfaces face the camera, whichever way the axes of its pose are written.
    toward = view.camera.center - RADIUS * surface.normals
    assert ((toward * surface.normals).sum(-1)[surface.covered] > 0).all()


@pytest.mark.parametrize("bits", [8, 16])
def test_strength_is_a_share(view: View, bits: int) -> None:
    if bits == 8:
        values = np.array(Image.open(beside(view, "_strength"))) // 257
        Image.fromarray(values.astype(np.uint8)).save(beside(view, "_strength"))
    strength = surface_of(view).strength
    assert strength is not None
    torch.testing.assert_close(strength.unique(), torch.tensor([0.0, 0.8]), atol=1e-4, rtol=0)


def test_a_smaller_view_has_the_mean_of_what_is_covered(tmp_path: Path) -> None:
    root = write_object_capture(tmp_path / "ball")
    large, small = (surface_of(load_dataset(root, downscale=d).test[0]) for d in (1.0, 2.0))
    assert large.normals is not None and small.normals is not None and small.strength is not None
    assert small.normals.shape == (SIZE // 2, SIZE // 2, 3)
    sums = large.normals.reshape(SIZE // 2, 2, SIZE // 2, 2, 3).sum(dim=(1, 3))
    shares = large.covered.reshape(SIZE // 2, 2, SIZE // 2, 2).float().mean(dim=(1, 3))
    assert torch.equal(small.covered, shares > 0.5)
    expected = torch.nn.functional.normalize(sums, dim=-1)[small.covered]
    torch.testing.assert_close(small.normals[small.covered], expected, atol=2e-3, rtol=0)


def test_each_file_may_be_absent(view: View) -> None:
    whole = surface_of(view)
    beside(view, "_strength").unlink()
    assert surface_of(view).strength is None and surface_of(view).normals is not None
    beside(view, "_normal").unlink()
    assert true_surface(view) is None
    Image.fromarray(np.full((SIZE, SIZE), 255, np.uint8)).save(beside(view, "_strength"))
    found = surface_of(view)
    assert found.normals is None and torch.equal(found.covered, whole.covered)


def test_without_alpha_of_their_own_normals_have_the_photograph_s(view: View) -> None:
    whole = surface_of(view)
    rewritten(view, "_normal", "RGB")
    assert torch.equal(surface_of(view).covered, whole.covered)
    rewritten(view, "", "RGB")
    # Black is not a normal, so the background can be distinguished from the surface even then.
    assert torch.equal(surface_of(view).covered, whole.covered)


def test_a_view_in_memory_has_no_files(view: View) -> None:
    assert true_surface(View.in_memory("a.png", view.camera, photo=view.photo)) is None


def test_another_size_is_refused(view: View) -> None:
    Image.open(beside(view, "_normal")).resize((20, 20)).save(beside(view, "_normal"))
    with pytest.raises(InputError, match=r"r_0_normal\.png is 20x20 pixels, its photograph 40x40"):
        true_surface(view)


def test_a_broken_file_is_named(view: View) -> None:
    beside(view, "_strength").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"r_0_strength\.png as an image"):
        true_surface(view)
