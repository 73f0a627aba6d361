"""`glassplat demo`: the bundled showcase, decomposed in a few minutes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from glassplat.commands.console.messages import say
from glassplat.commands.measuring.evaluate import evaluate_run, print_results
from glassplat.commands.runs.stored_run import open_run
from glassplat.commands.training.train import Train
from glassplat.data.ranges import Seed, Several
from glassplat.kernels.devices import DeviceName
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.run_directory import RunDirectory
from glassplat.train.splat_recipe import SplatRecipe

SCENE = Path(__file__).parents[2] / "demo_scene"


@dataclass(frozen=True)
class Demo:
    """Train planar and splat on the bundled showcase and compare them; goes on where it was interrupted.

    Attributes:
        output: where the two runs go.
        iterations: length of each run.
        seed: fixes every random choice.
        device: where to train; auto takes an NVIDIA GPU where one can be used.
    """

    output: Path = Path("runs/demo")
    iterations: Several = 3000
    seed: Seed = 0
    device: DeviceName = "auto"

    def run(self, console: Console) -> None:
        """Trains both methods, evaluates them and says where the pictures are."""
        results = []
        for recipe in (PlanarRecipe(), SplatRecipe()):
            folder = self.output / recipe.method
            begun = RunDirectory(folder).checkpoint.is_file()
            run = Train(recipe, SCENE, folder, self.iterations, seed=self.seed, device=self.device, resume=begun)
            run.run(console)
            results.append(evaluate_run(open_run(folder, self.device)))
        print_results(console, *results)
        say(console, f"pictures: {self.output / 'planar' / 'index.html'} and {self.output / 'planar' / 'sheets'}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"what is finished stays in {self.output}: repeat the command to go on"
