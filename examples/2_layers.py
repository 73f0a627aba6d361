"""Render transmission and reflection as separate layers, from the camera of a photograph and along a path.

python examples/2_layers.py runs/place --output pictures
"""

from pathlib import Path

import torch
import tyro
from PIL import Image

import glassplat


def save(path: Path, image: torch.Tensor) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * image).round().byte().numpy()).save(path)


def main(run: tyro.conf.Positional[Path], output: Path = Path("pictures"), frames: int = 4) -> None:
    model = glassplat.load(run)  # Or any .ply, .spz or .splat.
    print(model, "renders", ", ".join(model.layers))

    # `image` returns an image for display: [H, W, 3] in [0, 1].
    name = next(iter(model.cameras))
    for layer in model.layers:
        save(output / f"{layer}.png", model.image(name, layer))

    # `render` returns a frame of tensors for computations. Transmission, reflection and strength make up the image.
    with torch.no_grad():
        frame = model.render(name, layers=["transmission", "reflection", "strength", "depth"])
    print({layer: tuple(tensor.shape) for layer, tensor in frame.layers.items()})

    # Cameras can be placed anywhere, here on an orbit.
    for index, camera in enumerate(model.orbit(frames)):
        save(output / f"orbit_{index:03d}.png", model.image(camera.resize(480, 320)))


if __name__ == "__main__":
    tyro.cli(main)
