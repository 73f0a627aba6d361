"""Use the renderer in your own optimisation loop: recover the reflectance of a pane and the position of a camera.

python examples/4_gradients.py runs/place --data CAPTURE
"""

from dataclasses import replace
from pathlib import Path

import torch
import tyro

import glassplat

DEMO = Path(glassplat.__file__).parent / "demo_scene"


def main(run: tyro.conf.Positional[Path], data: Path = DEMO, downscale: float = 3.2, steps: int = 50) -> None:
    model = glassplat.load(run)
    view = glassplat.load_dataset(data, downscale=downscale).train[0]
    photo = view.photo.to(model.scene.primary.means) / 255

    # Every tensor of the scene has a name; a tensor that replaces it receives its gradient. R0 starts too high, ...
    logits = torch.full_like(model.scene.planes.logit_reflectances, 0.0).requires_grad_()
    # ... and the camera is shifted slightly from the position of the photograph.
    shift = torch.tensor([0.01, 0.0, 0.0]).mul(model.scene.extent).to(photo).requires_grad_()
    pose = view.camera.cam_from_world.to(photo)

    optimizer = torch.optim.Adam(
        [{"params": [logits], "lr": 0.2}, {"params": [shift], "lr": 1e-3 * model.scene.extent}]
    )
    for step in range(steps):
        moved = torch.cat([pose[:, :3], pose[:, 3:] + torch.nn.functional.pad(shift, (0, 1))[:, None]], dim=1)
        camera = replace(view.camera, cam_from_world=moved)
        frame = model.with_parameters({"planes.logit_reflectances": logits}).render(camera)
        loss = (frame.rgb - photo).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 10 == 0 or step == steps - 1:
            reflectances = ", ".join(f"{value:.3f}" for value in torch.sigmoid(logits).tolist())
            print(f"step {step}: loss {loss.item():.4f}, R0 {reflectances}, {shift.norm().item():.4f} aside")


if __name__ == "__main__":
    tyro.cli(main)
