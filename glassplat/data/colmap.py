"""COLMAP captures: a sparse model, binary or text, beside a folder of images.

With label images `masks/<photograph's stem>.png` for the annotated photographs only, this is also the layout for
captures of transparent panes such as RTR's, whose own files were never published.
"""

from __future__ import annotations

from os.path import isfile
from pathlib import Path

from glassplat.data.capture import Capture, RawPoints, Shot
from glassplat.data.colmap_model import Model, model_suffix, pose_matrix, read_model
from glassplat.data.errors import InputError, first_names

MODEL_FOLDERS = ("sparse/0", "sparse", ".")
LOOKED_FOR = "a COLMAP model (cameras and images as .bin or .txt in sparse/0, sparse or the folder itself)"


def load_colmap(root: Path) -> Capture | None:
    """Read a COLMAP capture with photographs in `images/`; None when there is no model.

    Raises:
        InputError: the model is damaged, or photographs of it are missing.
    """
    folder = next((root / name for name in MODEL_FOLDERS if model_suffix(root / name)), None)
    if folder is None:
        return None
    model = read_model(folder)
    shots = _shots(root, model)
    return Capture(
        shots=shots,
        test_shots=None,
        points=_points_or_none(model),
        format_name="COLMAP",
        warnings=_other_models(root, folder),
    )


def _shots(root: Path, model: Model) -> tuple[Shot, ...]:
    """Every registered image, with an error that counts what is missing."""
    images = root / "images"
    if not images.is_dir():
        raise InputError(
            f"no folder {images} beside the COLMAP model; expected the {len(model.images)} photographs there"
        )
    missing = sorted(image.name for image in model.images if not isfile(images / image.name))
    if missing:
        raise InputError(
            f"{len(missing)} of the {len(model.images)} photographs of the COLMAP model are missing in {images}: "
            f"{first_names(missing)}; copy them there, or remove them from the model"
        )
    orphans = sorted(image.name for image in model.images if image.camera_id not in model.lenses)
    if orphans:
        raise InputError(
            f"photographs whose camera is not in the COLMAP model: {first_names(orphans)}; export it again"
        )
    return tuple(
        Shot(image.name, images / image.name, model.lenses[image.camera_id], pose_matrix(image))
        for image in model.images
    )


def _points_or_none(model: Model) -> RawPoints | None:
    return model.points if len(model.points) else None


def _other_models(root: Path, used: Path) -> tuple[str, ...]:
    """COLMAP splits what it cannot connect into several models; only one can be trained at a time."""
    sparse = root / "sparse"
    others = (
        sorted(p.name for p in sparse.iterdir() if p != used and p.is_dir() and model_suffix(p))
        if sparse.is_dir()
        else []
    )
    if not others:
        return ()
    return (f"{used} is used; there are more models in {sparse} ({first_names(others)}), which are left out.",)
