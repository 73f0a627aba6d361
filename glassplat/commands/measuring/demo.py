"""`glassplat demo`: the bundled showcase, decomposed in a few minutes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from glassplat.commands.console.loading import load
from glassplat.commands.console.messages import say
from glassplat.commands.measuring.beside import beside
from glassplat.commands.runs.output_folder import check_targets
from glassplat.data.ranges import Seed, Several
from glassplat.files.folders import check_folder
from glassplat.kernels.devices import DeviceName
from glassplat.train.run_directory import RunDirectory

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

    def ready(self) -> None:
        """Refuses an output that cannot be written, and imports what trains and renders."""
        check_folder(self.output)
        check_targets(self.output, [self.log, *self.folders], [])
        load("glassplat.commands.training.train")
        load("glassplat.commands.measuring.evaluation")
        from glassplat.train.planar_recipe import PlanarRecipe
        from glassplat.train.stage import check_length

        check_length(PlanarRecipe().stages(self.seed, self.iterations), self.iterations)

    @property
    def folders(self) -> list[Path]:
        """Of the two runs."""
        return [self.output / "planar", self.output / "splat"]

    @property
    def log(self) -> Path:
        """What the training beside this one says."""
        return self.output / "splat.log"

    def run(self, console: Console) -> None:
        """Trains both methods, each in a process of its own, evaluates them and says where the pictures are."""
        from glassplat.commands.measuring.evaluation import evaluate_run, print_results
        from glassplat.commands.runs.stored_run import open_run
        from glassplat.commands.training.train import Train
        from glassplat.train.planar_recipe import PlanarRecipe
        from glassplat.train.splat_recipe import SplatRecipe

        with beside(self._arguments(SplatRecipe.method), self.log) as splat:
            say(console, f"planar is trained here, and splat beside it: {self.log}")
            here = Train(PlanarRecipe(), SCENE, self.folders[0], self.iterations, seed=self.seed, device=self.device)
            here.resuming(begun(self.folders[0])).run(console)
            with console.status("waiting for splat"):
                splat.wait()
        print_results(console, *(evaluate_run(open_run(folder, self.device)) for folder in self.folders))
        say(console, f"pictures: {self.output / 'planar' / 'index.html'} and {self.output / 'planar' / 'sheets'}")

    def _arguments(self, method: str) -> list[str]:
        """Of the command line that trains one method, or goes on where it was interrupted."""
        folder = self.output / method
        run = ["train", method, "--data", str(SCENE), "--output", str(folder), "--iterations", str(self.iterations)]
        return [*run, "--seed", str(self.seed), "--device", self.device, *(["--resume"] if begun(folder) else [])]

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"what is finished stays in {self.output}: repeat the command to go on"


def begun(folder: Path) -> bool:
    """Whether there is a run to go on with."""
    return RunDirectory(folder).checkpoint.is_file()
