"""Train a scene with a window pane, and follow the training step by step.

python examples/1_train.py --data CAPTURE --output runs/place --iterations 7000
"""

from pathlib import Path

import tyro

import glassplat

DEMO = Path(glassplat.__file__).parent / "demo_scene"


def main(data: Path = DEMO, output: Path = Path("runs/place"), iterations: int = 3000, downscale: float = 3.2) -> None:
    dataset = glassplat.load_dataset(data, downscale=downscale)
    print(
        f"{len(dataset.train)} photographs to learn from, {len(dataset.test)} to test with, panes {dataset.pane_labels}"
    )

    # A recipe is a dataclass whose fields are the training options. Pass "planar" instead for the defaults.
    recipe = glassplat.PlanarRecipe(sh_degree=2, fresnel="pane")
    training = glassplat.Training(dataset, recipe, iterations=iterations, output=output)

    # You own the loop: between two messages, `training.model` is the current model.
    for message in training:
        match message:
            case glassplat.StageEntered(step=step, stage=stage):
                print(f"step {step}: stage {stage}")
            case glassplat.StepDone(step=step, loss=loss) if step % 100 == 0:
                print(f"step {step}: loss {loss:.4f}, {len(training.model.scene.primary)} Gaussians")

    scores = training.model.evaluate(dataset)
    print(
        f"PSNR {scores['psnr']:.2f} dB over the test views, {scores['pane_psnr'] or float('nan'):.2f} dB over the panes"
    )


if __name__ == "__main__":
    tyro.cli(main)
