"""Edit the panes of a scene: remove the glass, make it a mirror, move it, add another pane; save and publish it.

python examples/3_panes.py runs/place --output edited
"""

from pathlib import Path

import tyro

import glassplat


def main(run: tyro.conf.Positional[Path], output: Path = Path("edited")) -> None:
    model = glassplat.load(run)
    pane = model.panes[0]

    # Models are immutable: an edit returns a new model, which shares all unchanged tensors with the old one.
    edits = {
        "without_glass": model.without_glass(),
        "mirror": model.with_mirrors(pane),
        "faint": model.with_reflectance(pane, 0.02),
        "moved": model.shift_pane(pane, 0.02 * model.scene.extent).tilt_pane(pane, 5),
    }
    name = next(iter(model.cameras))
    for edit, edited in edits.items():
        print(
            edit, f"changes the image by {float((edited.image(name) - model.image(name)).abs().mean()):.4f} on average"
        )

    # Add a mirror by its centre, its normal and its half sizes; this also works in scenes of other programs.
    planes = model.scene.planes
    size = 0.2 * model.scene.extent
    position = planes.centers[0] + 0.1 * model.scene.extent * planes.normals[0]
    mirrored = model.with_pane(position.tolist(), planes.normals[0].tolist(), (size, size), base_reflectance=1)
    print(mirrored)

    # Save for other programs, with the panes in a separate file; as a page for any browser; and as a run to reload.
    for file in ("mirror.ply", "page.html", "run"):
        print("->", edits["mirror"].save(output / file))


if __name__ == "__main__":
    tyro.cli(main)
