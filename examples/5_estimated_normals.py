"""Estimate normals from each single photograph, from which `traced` and `deferred` learn shapes.

python examples/5_estimated_normals.py --data CAPTURE

The network is Metric3D (https://github.com/YvanYin/Metric3D, BSD-2), which torch.hub downloads with its weights; it
needs `pip install mmengine timm`. Any repository or folder with a `hubconf.py` of the same interface works too.
"""

from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate, normalize, pad

import glassplat

MEAN, STD = torch.tensor([123.675, 116.28, 103.53]), torch.tensor([58.395, 57.12, 57.375])
"""Statistics of the training images of the network, per channel."""


def main(
    data: Path,
    repository: str = "yvanyin/metric3d",
    model: str = "metric3d_vit_small",
    height: int = 616,
    width: int = 1064,
    device: str = "cuda" if torch.cuda.is_available() else "cpu",
) -> None:
    dataset = glassplat.load_dataset(data)
    source = "local" if Path(repository).is_dir() else "github"
    try:
        network = torch.hub.load(repository, model, source=source, pretrain=True).to(device).eval()
    except (OSError, RuntimeError) as error:
        raise SystemExit(
            f"error: torch.hub cannot load {model} of {repository}: {error}\nExpected access to github.com and to the "
            "weights; or give a folder with a hubconf.py, fetched elsewhere, as --repository"
        ) from None
    for number, view in enumerate(dataset.train, start=1):
        normals = estimated(network, view.photo.to(device), height, width).cpu().numpy()
        path = view.image_path.parent / "normals" / f"{view.image_path.stem}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(np.round(255 * (normals + 1) / 2).astype(np.uint8)).save(path)
        print(f"{number}/{len(dataset.train)}: {path}")


@torch.no_grad()
def estimated(network: torch.nn.Module, photo: Tensor, height: int, width: int) -> Tensor:
    """Unit normals [H, W, 3] of a photograph [H, W, 3], 0 to 255: x to the right, y up, z towards the camera."""
    rows, columns = photo.shape[:2]
    scale = min(height / rows, width / columns)
    picture = (photo.float() - MEAN.to(photo.device)) / STD.to(photo.device)
    picture = interpolate(picture.permute(2, 0, 1)[None], scale_factor=scale, mode="bilinear", antialias=True)
    # The network expects images of one size: the remainder is filled with the mean colour.
    above, before = (height - picture.shape[2]) // 2, (width - picture.shape[3]) // 2
    filled = pad(picture, (before, width - picture.shape[3] - before, above, height - picture.shape[2] - above))
    found = network.inference({"input": filled})[2]["prediction_normal"][:, :3]
    # Some networks return images smaller than their input.
    found = interpolate(found, (height, width), mode="bilinear")
    shown = found[:, :, above : above + picture.shape[2], before : before + picture.shape[3]]
    normals = normalize(interpolate(shown, (rows, columns), mode="bilinear")[0].permute(1, 2, 0), dim=-1)
    # Visible surfaces face the camera, which distinguishes z forward and y down from z backward and y up.
    return normals if normals[..., 2].mean() > 0 else normals * normals.new_tensor([1.0, -1.0, -1.0])


if __name__ == "__main__":
    tyro.cli(main)
