"""Gaussian splatting for scenes with window panes, showcases and mirrors.

    import glassplat

    dataset = glassplat.load_dataset("shop", downscale=2)  # photographs, poses, masks of panes
    model = glassplat.Training(dataset, "planar", iterations=7000).run()  # or glassplat.load("runs/shop")
    frame = model.render("IMG_0042.jpg", layers=["transmission", "reflection"])  # tensors, with gradients
    model.with_mirrors(1).without_pane(2).save("shop.html")  # edits are new models

`load` reads a run, or a splat file of any program, as a `Model`, which renders, is edited and is saved. `load_dataset`
reads a capture as a `Dataset`; `Training` trains on it and tells what happens, message by message. A scene is plain
data: `Scene`, `Gaussians`, `Planes`, `Camera`; a renderer is a function `(scene, camera) -> Frame`; a recipe is what a
method trains with. Axes are OpenCV's, poses are `cam_from_world`, images `[H, W, 3]` in sRGB, angles in radians unless
a name says otherwise.
"""

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from glassplat.data.dataset import Dataset, load_dataset
    from glassplat.data.errors import InputError
    from glassplat.data.view import View
    from glassplat.interface.loading import load
    from glassplat.interface.model import Model
    from glassplat.interface.training import Training
    from glassplat.losses.term import LossTerm
    from glassplat.render.deferred import Deferred
    from glassplat.render.frame import Frame
    from glassplat.render.planar import Planar
    from glassplat.render.splat import Splat
    from glassplat.render.traced import Traced
    from glassplat.scene.camera import Camera
    from glassplat.scene.environment import Environment
    from glassplat.scene.gaussians import Gaussians
    from glassplat.scene.plane import Planes
    from glassplat.scene.scene import Scene
    from glassplat.train.deferred_recipe import DeferredRecipe
    from glassplat.train.messages import ActionDone, CheckpointWritten, RunBegun, StageEntered, StepDone, Working
    from glassplat.train.planar_recipe import PlanarRecipe
    from glassplat.train.splat_recipe import SplatRecipe
    from glassplat.train.stage import Stage
    from glassplat.train.traced_recipe import TracedRecipe

# PyTorch and Numba each keep a pool of threads. Waiting threads that spin, as OpenMP's do unless told otherwise, take
# the cores from the other pool: a training step then costs up to twice as much. It is read once, when OpenMP loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
__all__ = [  # noqa: RUF022 - In the order in which the documentation tells of them.
    "load",
    "load_dataset",
    "Model",
    "Training",
    "Dataset",
    "View",
    "Camera",
    "Scene",
    "Gaussians",
    "Planes",
    "Environment",
    "Frame",
    "SplatRecipe",
    "PlanarRecipe",
    "DeferredRecipe",
    "TracedRecipe",
    "Stage",
    "LossTerm",
    "Splat",
    "Planar",
    "Deferred",
    "Traced",
    "StepDone",
    "StageEntered",
    "ActionDone",
    "Working",
    "CheckpointWritten",
    "RunBegun",
    "InputError",
]

HOMES = {
    "data.dataset": ("Dataset", "load_dataset"),
    "data.errors": ("InputError",),
    "data.view": ("View",),
    "interface.loading": ("load",),
    "interface.model": ("Model",),
    "interface.training": ("Training",),
    "losses.term": ("LossTerm",),
    "render.deferred": ("Deferred",),
    "render.frame": ("Frame",),
    "render.planar": ("Planar",),
    "render.splat": ("Splat",),
    "render.traced": ("Traced",),
    "scene.camera": ("Camera",),
    "scene.environment": ("Environment",),
    "scene.gaussians": ("Gaussians",),
    "scene.plane": ("Planes",),
    "scene.scene": ("Scene",),
    "train.deferred_recipe": ("DeferredRecipe",),
    "train.messages": ("ActionDone", "CheckpointWritten", "RunBegun", "StageEntered", "StepDone", "Working"),
    "train.planar_recipe": ("PlanarRecipe",),
    "train.splat_recipe": ("SplatRecipe",),
    "train.stage": ("Stage",),
    "train.traced_recipe": ("TracedRecipe",),
}
"""Where each public name lives; its module is imported, and PyTorch with it, when the name is first used."""


def __getattr__(name: str) -> Any:
    """A public name, imported now."""
    home = next((module for module, names in HOMES.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module 'glassplat' has no attribute {name!r}; it has {', '.join(__all__)}")
    import importlib

    globals()[name] = found = getattr(importlib.import_module(f"glassplat.{home}"), name)
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
