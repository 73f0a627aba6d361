"""`glassplat demo`: the bundled showcase, decomposed in a few minutes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from glassplat.cli.console import say
from glassplat.cli.places import check_targets
from glassplat.cli.train import Train
from glassplat.errors import InputError
from glassplat.files.writing import check_folder
from glassplat.kernels.backend.devices import DeviceName
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import Recipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import RunDirectory
from glassplat.options import Seed, Several

SCENE = Path(__file__).parents[1] / "demo_scene"
LEAST_ITERATIONS = 8
"""Of which each stage of `planar` gets one."""


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

    def ready(self) -> None:
        """Refuses an output that cannot be written, and a run that is too short for the stages of `planar`."""
        check_folder(self.output)
        check_targets(self.output, self.folders, [])
        if self.iterations < LEAST_ITERATIONS:
            raise InputError(f"--iterations is {self.iterations}; expected at least {LEAST_ITERATIONS}")

    @property
    def folders(self) -> list[Path]:
        """Of the two runs."""
        return [self.output / method for method in (PlanarRecipe.method, SplatRecipe.method)]

    def run(self, console: Console) -> None:
        """Trains both methods, evaluates them and says where the pictures are."""
        recipes: tuple[Recipe, ...] = (PlanarRecipe(), SplatRecipe())
        for recipe, folder in zip(recipes, self.folders, strict=True):
            run = Train(recipe, SCENE, folder, self.iterations, seed=self.seed, device=self.device)
            run = run.resuming(RunDirectory(folder).checkpoint.is_file())
            say(console, f"training {recipe.method}")
            run.ready()
            run.run(console)
        from glassplat.cli.evaluation import evaluate_run, print_results
        from glassplat.cli.runs import open_run

        print_results(console, *(evaluate_run(open_run(folder, self.device)) for folder in self.folders))
        say(console, f"pictures: {self.output / 'planar' / 'index.html'} and {self.output / 'planar' / 'sheets'}")

    def left_behind(self) -> str:
        """Text after an interrupt: the state on disk, and how to go on."""
        return f"what is finished stays in {self.output}: repeat the command to go on"
