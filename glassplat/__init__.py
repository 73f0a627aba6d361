"""Gaussian splatting for scenes with window panes, showcases and mirrors.

    import glassplat

    dataset = glassplat.load_dataset("shop", downscale=2)  # photographs, poses, masks of panes
    model = glassplat.Training(dataset, "planar", iterations=7000).run()  # or glassplat.load("runs/shop")
    frame = model.render("IMG_0042.jpg", layers=["transmission", "reflection"])  # tensors, with gradients
    model.with_mirrors(1).save("shop.html")  # edits are new models

`load` reads a run, or a splat file of any program, as a `Model`, which renders, is edited and is saved. `load_dataset`
reads a capture as a `Dataset`; `Training` trains on it and yields messages. A scene is plain data: `Scene`,
`Gaussians`, `Planes`, `Camera`; a renderer is a function `(scene, camera) -> Frame`; a recipe holds the options of a
method. Axes are OpenCV's, poses are `cam_from_world`, images `[H, W, 3]` in sRGB, angles in radians unless a name says
otherwise.
"""

import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from glassplat.captures.dataset import Dataset, load_dataset
    from glassplat.captures.view import PointCloud, View
    from glassplat.errors import InputError
    from glassplat.methods.glossy_recipes import DeferredRecipe, TracedRecipe
    from glassplat.methods.planar_recipe import PlanarRecipe
    from glassplat.methods.splat_recipe import SplatRecipe
    from glassplat.model.model import Model, load
    from glassplat.model.training import Training
    from glassplat.options import Cleaning
    from glassplat.render.deferred import Deferred
    from glassplat.render.frame import Frame
    from glassplat.render.planar import Planar
    from glassplat.render.rasterization import rasterization
    from glassplat.render.splat import Splat
    from glassplat.render.traced import Traced
    from glassplat.scene.camera import Camera
    from glassplat.scene.gaussians import Gaussians
    from glassplat.scene.panes import Planes
    from glassplat.scene.scene import Environment, Scene
    from glassplat.training.losses import LossTerm
    from glassplat.training.messages import ActionDone, CheckpointWritten, RunBegun, StageEntered, StepDone, Working
    from glassplat.training.stage import Stage

# PyTorch and Numba each have a thread pool. By default, waiting threads of OpenMP spin and take cores from the other
# pool, which makes a training step up to twice as slow. The variable is read once, when OpenMP loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
__all__ = [  # noqa: RUF022 - In the order of the documentation.
    "load",
    "load_dataset",
    "Model",
    "Training",
    "Dataset",
    "View",
    "PointCloud",
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
    "Cleaning",
    "rasterization",
    "StepDone",
    "StageEntered",
    "ActionDone",
    "Working",
    "CheckpointWritten",
    "RunBegun",
    "InputError",
]

NAMES_BY_MODULE = {
    "captures.dataset": ("Dataset", "load_dataset"),
    "captures.view": ("PointCloud", "View"),
    "errors": ("InputError",),
    "methods.glossy_recipes": ("DeferredRecipe", "TracedRecipe"),
    "methods.planar_recipe": ("PlanarRecipe",),
    "methods.splat_recipe": ("SplatRecipe",),
    "model.model": ("Model", "load"),
    "model.training": ("Training",),
    "options": ("Cleaning",),
    "render.deferred": ("Deferred",),
    "render.frame": ("Frame",),
    "render.planar": ("Planar",),
    "render.rasterization": ("rasterization",),
    "render.splat": ("Splat",),
    "render.traced": ("Traced",),
    "scene.camera": ("Camera",),
    "scene.gaussians": ("Gaussians",),
    "scene.panes": ("Planes",),
    "scene.scene": ("Environment", "Scene"),
    "training.losses": ("LossTerm",),
    "training.messages": ("ActionDone", "CheckpointWritten", "RunBegun", "StageEntered", "StepDone", "Working"),
    "training.stage": ("Stage",),
}
"""Modules of the public names; they are imported, with PyTorch, on first use."""


def __getattr__(name: str) -> Any:
    """A public name, imported on first use."""
    module_name = next((module for module, names in NAMES_BY_MODULE.items() if name in names), None)
    if module_name is None:
        raise AttributeError(f"module 'glassplat' has no attribute {name!r}; it has {', '.join(__all__)}")
    import importlib

    globals()[name] = found = getattr(importlib.import_module(f"glassplat.{module_name}"), name)
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
