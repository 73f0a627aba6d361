"""A trained scene with its cameras, to be rendered, edited and saved."""

from __future__ import annotations

import html
import json
import logging
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from glassplat.access import LOCALHOST
from glassplat.captures import dataset as captures
from glassplat.errors import InputError, convert_to_input_error, count_noun, join_names
from glassplat.files import writing
from glassplat.files.ply import read_gaussians, write_gaussians
from glassplat.files.records import read_text
from glassplat.files.scene_folder import read_splats, select_drawable
from glassplat.files.sidecars import planes_json, read_cameras, read_planes, write_cameras, write_equirect, write_planes
from glassplat.kernels.backend.devices import DeviceName, chosen_device
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import recipe_to_json, resolve_background, with_background
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import RunDirectory
from glassplat.options import BLACK, CLEAR_GLASS, Cleaning, Up, short_repr
from glassplat.publish import web_page
from glassplat.publish.camera_paths import orbit
from glassplat.publish.cleaning import Floaters, clean_scene
from glassplat.render.deferred import equirect_from_environment
from glassplat.render.frame import Frame, Renderer, check_layers
from glassplat.render.layers import layer_image
from glassplat.render.planar import with_photographer
from glassplat.scene import scene
from glassplat.scene.camera import LEAST_SINE, Camera
from glassplat.scene.corrections import DEFAULT_UP, estimate_up
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene, covering_glass, with_intensity, with_pane
from glassplat.viewer.drawing import ViewerState, Writer
from glassplat.viewer.render_loop import vacant_port
from glassplat.viewer.server import Viewer

NOTEBOOK_WIDTH = 480
"""Pixels."""


@dataclass(frozen=True, eq=False, repr=False)
class Model:
    """A scene, the method that renders it, and the cameras of its photographs.

    Models are immutable: edits return a new model, which shares unedited tensors.

    Attributes:
        scene: Gaussians and panes; `scene.parameters()` has all trainable tensors by name.
        recipe: options of the method, which also define the renderer.
        cameras: by the names of their photographs; for a splat file without cameras, some around it.
        name: name for display.
        path: where it was loaded from; None if created in memory.
    """

    scene: Scene
    recipe: Any
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    name: str = ""
    path: Path | None = None

    def __repr__(self) -> str:
        return (
            f"Model({self.name!r}: {self.recipe.method}, {len(self.scene.primary)} Gaussians, "
            f"{count_noun(len(self.scene.planes), 'pane')}, {count_noun(len(self.cameras), 'camera')})"
        )

    def _repr_html_(self) -> str:
        """A small image from a camera that shows the panes well, for notebooks."""
        text = html.escape(repr(self))
        if not self.cameras:
            return f"<p>{text}</p>"
        names = tuple(self.cameras)
        name = names[web_page.best_view(self.scene.planes, tuple(self.cameras.values()))]
        small = web_page.limit_width(self.cameras[name], NOTEBOOK_WIDTH)
        encoded = web_page.base64_text(web_page.jpeg_bytes(self.image(small), quality=90))
        return f'<p>{text}</p><img src="data:image/jpeg;base64,{encoded}" alt="{html.escape(name)}">'

    def show(self) -> Viewer:
        """Starts the viewer of `glassplat view`, at the `address` of the returned object, until its `stop()`.

        Raises:
            InputError: viser is not installed.
        """
        viewer = Viewer(viewer_state(replace(self, cameras=self.viewpoints), {}), LOCALHOST, vacant_port(LOCALHOST))
        viewer.start()
        return viewer

    @property
    def renderer(self) -> Renderer:
        """Renderer of the scene: a function `(scene, camera) -> Frame`."""
        renderer: Renderer = self.recipe.renderer()
        return renderer

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers for display, starting with `rgb`."""
        return self.renderer.layers(self.scene)

    @property
    def panes(self) -> tuple[int, ...]:
        """Labels of the panes, as in the masks."""
        return self.scene.planes.labels

    @property
    def viewpoints(self) -> Mapping[str, Camera]:
        """Its cameras; without any, some around the scene, with -y up.

        Raises:
            InputError: it has neither cameras nor Gaussians.
        """
        up = torch.tensor(AXES["-y"], dtype=torch.float64)
        return self.cameras or dict(web_page.cameras_around(self.scene.primary, up))

    def render(self, camera: Camera | str, *, layers: Sequence[str] = ("rgb",)) -> Frame:
        """Renders the image and its layers; differentiable in every tensor of the scene and in the camera's pose.

        Kernels have first derivatives only: second ones, as with `create_graph=True`, are refused, or zero if the loss
        is linear in the image.

        `frame.rgb` is [H, W, 3] in sRGB, not clamped; `frame.layers` are further images by name, [H, W] or [H, W, 3].
        It is faster under `torch.no_grad()`.

        Args:
            camera: any pinhole camera, or the name of one of `cameras`.
            layers: layers of the frame.

        Raises:
            InputError: a layer or camera name is unknown, in which case the message lists the known ones; or an
                argument has the wrong type.
        """
        layers = layers if isinstance(layers, str) else tuple(layers)
        frame = self._frame(camera, layers)
        return replace(frame, layers={name: layer for name, layer in frame.layers.items() if name in layers})

    def _frame(self, camera: Camera | str, layers: Sequence[str]) -> Frame:
        """The frame with these layers, and with by-products of the renderer."""
        if isinstance(layers, str):
            raise InputError(f"layers is {layers!r}; expected a sequence of names, such as ({layers!r},)")
        check_layers(self.renderer, self.scene, layers, self.recipe.method)
        if not isinstance(camera, (str, Camera)):
            raise InputError(f"camera is {short_repr(camera)}; expected one Camera, or the name of one of `cameras`")
        if isinstance(camera, str):
            if camera not in self.cameras:
                raise InputError(f"there is no camera {camera!r}; expected one of {join_names(list(self.cameras))}")
            camera = self.cameras[camera]
        return self.renderer.with_layers(layers)(self.scene, camera)

    @torch.no_grad()
    def image(self, camera: Camera | str, layer: str = "rgb") -> Tensor:
        """One layer for display: [H, W, 3] in [0, 1], on the CPU. Depth is colour-mapped, normals are (n + 1) / 2.

        Args:
            camera: any pinhole camera, or the name of one of `cameras`.
            layer: one of `layers`.

        Raises:
            InputError: as `render` does.
        """
        image = layer_image(self._frame(camera, (layer,)), layer).cpu()
        return image if image.dim() == 3 else image[..., None].expand(-1, -1, 3)

    def orbit(self, frames: int) -> list[Camera]:
        """Cameras on an orbit, or on a loop in front of a scene photographed from one side."""
        return orbit(list(self.viewpoints.values()), self.scene.extent, frames)

    def evaluate(self, dataset: captures.Dataset) -> dict[str, Any]:
        """Metrics over the test views of a data set, by name: `psnr`, `ssim`, `pane_psnr` ...

        If a metric is None, `<name>_reason` has the reason. Unlike `glassplat eval`, it takes panes from the ground
        truth or the rendered mask, never from masks of the capture; after pose refinement, test cameras are moved like
        their neighbours instead of being aligned with their photographs. Nothing is written.

        Raises:
            InputError: `dataset` is something else, or its photographs lie over another background than the model's.
        """
        captures.check_dataset(dataset)
        from glassplat.evaluate.evaluate import evaluate  # Imported here, because training rarely needs it.

        resolve_background(with_background(self.recipe, BLACK), dataset)
        scene, renderer = self.scene, with_photographer(self.renderer, "separate")
        if dataset.test:
            scene = scene.to(dataset.test[0].camera.cam_from_world.dtype)
        return evaluate(scene, renderer, captures.with_corrected_cameras(dataset, scene)).results

    def to(self, device: torch.device | torch.dtype | str) -> Model:
        """The same on another device, or in another precision, as float64 for `torch.autograd.gradcheck`.

        Cameras stay where they are: rendering takes them to the scene's device.

        Raises:
            CudaUnavailableError: a GPU was requested, but cannot be used.
            ValueError: the device is not one of `auto`, `cpu` and `cuda`.
        """
        if not isinstance(device, torch.dtype):
            return replace(self, scene=self.scene.to(chosen_device(device)))
        cameras = {name: camera.to(device) for name, camera in self.cameras.items()}
        return replace(self, scene=self.scene.to(device), cameras=cameras)

    def with_scene(self, scene: Scene) -> Model:
        """The model with another scene."""
        return replace(self, scene=scene)

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Model:
        """The model with some tensors replaced, by their names in `scene.parameters()`; gradients flow to them."""
        return self.with_scene(self.scene.with_parameters(parameters))

    def clean(self, cleaning: Cleaning | None = None) -> tuple[Model, dict[str, int]]:
        """The model without floaters, and the number of Gaussians found by each rule.

        Args:
            cleaning: the rules; the default ones if None.

        Raises:
            InputError: no Gaussians would be left, or there are none.
        """
        centers = torch.stack([camera.center for camera in self.viewpoints.values()])
        cleaned, found = clean_scene(self.scene, Floaters(self.scene.primary, centers), cleaning or Cleaning())
        return self.with_scene(cleaned), found

    def scale(self, factor: float) -> Model:
        """The model and its cameras in other units; it no longer matches the capture.

        Raises:
            ValueError: the factor is not positive and finite.
        """
        cameras = {name: camera.scale(factor) for name, camera in self.cameras.items()}
        return replace(self, scene=scene.scale_scene(self.scene, factor), cameras=cameras, path=None)

    def without_glass(self) -> Model:
        """The model without panes, so that nothing reflects."""
        return self.with_scene(scene.without_glass(self.scene))

    def without_pane(self, label: int) -> Model:
        """The model without one of its panes.

        Raises:
            ValueError: no pane has the label.
        """
        return self.with_scene(scene.without_pane(self.scene, label))

    def with_mirrors(self, *labels: int) -> Model:
        """The model with the panes of these labels turned into perfect mirrors.

        Raises:
            ValueError: no pane has one of the labels.
        """
        return self.with_scene(scene.as_mirrors(self.scene, labels))

    def with_reflectance(self, label: int, base_reflectance: float) -> Model:
        """The model with another reflectance R0 of a pane, at normal incidence; Fresnel's laws add to it at an angle.

        Below 1, a mirror becomes an ordinary pane, whose reflectance is trainable.

        Raises:
            ValueError: no pane has the label, or the reflectance is not in [0, 1].
        """
        return self.with_scene(scene.with_reflectance(self.scene, label, base_reflectance))

    def shift_pane(self, label: int, distance: float) -> Model:
        """The model with a pane shifted along its normal by a distance in world units.

        Raises:
            ValueError: no pane has the label, or the distance is not finite.
        """
        return self.with_scene(scene.shift_pane(self.scene, label, distance))

    def tilt_pane(self, label: int, about_tangent: float, about_bitangent: float = 0.0) -> Model:
        """The model with a pane tilted about its centre, by degrees about its first and second side.

        Raises:
            ValueError: no pane has the label, or an angle is not finite.
        """
        return self.with_scene(scene.tilt_pane(self.scene, label, about_tangent, about_bitangent))

    def with_pane(
        self,
        center: Sequence[float],
        normal: Sequence[float],
        half_sizes: tuple[float, float],
        *,
        tangent: Sequence[float] | None = None,
        base_reflectance: float = CLEAR_GLASS,
        label: int | None = None,
    ) -> Model:
        """The model with an additional pane, even if it was trained without any.

        Args:
            center: [3] centre of the rectangle, world units.
            normal: [3] of any length.
            half_sizes: half its sides along tangent and bitangent, world units.
            tangent: [3] direction of its first side; horizontal if None, assuming upright cameras.
            base_reflectance: R0; that of clear glass if not given, 1 makes a mirror.
            label: label of the pane, 1 to 255; the first free one if None.

        Raises:
            ValueError: the label is taken, a direction has length 0, a value is out of range, the method is neither
                `planar` nor `splat`, or the Gaussians are discs.
        """
        free = next(number for number in range(1, len(self.panes) + 2) if number not in self.panes)
        tangent = self._horizontal_direction(normal) if tangent is None else tangent
        pane = Planes.rectangle(center, normal, half_sizes, tangent=tangent, label=free if label is None else label)
        added = with_pane(self.scene, pane)
        recipe = self.recipe
        if isinstance(recipe, SplatRecipe) and recipe.primitive == "ellipsoid":
            recipe = PlanarRecipe(background=recipe.background)
        elif not isinstance(recipe, PlanarRecipe):
            raise ValueError(
                f"panes cannot be put into a scene of {recipe.method}; expected one of planar, or splat's ellipsoids"
            )
        recipe.renderer().check(added)
        model = replace(self, scene=added, recipe=recipe).with_reflectance(pane.labels[0], base_reflectance)
        return model.with_mirrors(*pane.labels) if base_reflectance == 1 else model

    def _horizontal_direction(self, normal: Sequence[float]) -> list[float] | None:
        """[3] horizontal direction perpendicular to a normal; None if undetermined."""
        up = estimate_up([*self.cameras.values()]) if self.cameras else DEFAULT_UP
        across = np.asarray([*normal], np.float64)
        level = np.cross(up, across) if across.shape == (3,) else np.zeros(3)
        return level.tolist() if np.linalg.norm(level) > LEAST_SINE * np.linalg.norm(across) else None

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Writes the model; `glassplat.load` reads folders completely, and splat files as far as their format allows.

        A scene from a splat file is rendered on black with the default options of `planar`, without reflections of
        glossy objects. A warning lists what the format cannot store.

        Args:
            path: without suffix a folder in the layout of a run, with bit-identical float32 tensors; .ply, .spz or
                .glb for other programs, with the panes next to it as `planes.json` and `glass.ply`, the cameras as
                `cameras.json`, and an environment, which only other programs read, as `environment.png` and `.json`;
                .html for a page that shows it with live panes in a browser, and is not loaded again.
            overwrite: replace existing files.

        Returns:
            The path.

        Raises:
            FileExistsError: a file exists already; nothing was written.
            InputError: the format is not known, or cannot hold this model.
        """
        path = Path(path)
        kind = path.suffix.lower().removeprefix(".")
        writing.check_scene_name(path)
        if not kind:
            return save_folder(self, path, overwrite=overwrite)
        if not overwrite:
            check_replaces_nothing(self, path)
        writing.make_folder(path.parent)
        if kind not in writing.SPLAT_WRITERS:
            save_page(self, path, self.name or path.stem)
            return path
        with convert_to_input_error():
            writing.write_splats(kind, path, self.scene.primary)
        if lost := unsaved_parts(self, kind):
            log.warning("%s leaves out %s; a folder, saved without a suffix, holds everything", path, ", ".join(lost))
        write_sidecars(path.parent, self.scene)
        if not len(self.scene.planes) and (path.parent / PLANES).exists():
            write_planes(path.parent / PLANES, self.scene.planes)  # Panes of a previous file must not be used.
        write_cameras(path.parent / CAMERAS, self.cameras.items())
        return path


def viewer_state(
    model: Model, photographs: Mapping[str, Callable[[], Tensor]], writer: Writer | None = None
) -> ViewerState:
    """The content of the viewer for a model.

    Args:
        model: the model to show.
        photographs: [H, W, 3] uint8 by name, read when asked for.
        writer: saves edits and keyframes of the browser; None if saving is disabled.
    """
    return ViewerState(model.name, model.scene, model.renderer, tuple(model.cameras.items()), photographs, writer)


def name_cameras(cameras: Iterable[tuple[str, Camera]]) -> dict[str, Camera]:
    """Cameras by name; duplicates get a number."""
    named: dict[str, Camera] = {}
    for name, camera in cameras:
        free, number = name, 1
        while free in named:
            number += 1
            free = f"{name} #{number}"
        named[free] = camera
    return named


PLANES, GLASS, CAMERAS = "planes.json", "glass.ply", "cameras.json"
EXPORT_STEM = "scene"
"""File name, without suffix, of exported splats."""
SETTINGS_FILE = "settings.json"
PANORAMA, ENVIRONMENT = "environment.png", "environment.json"


def check_replaces_nothing(model: Model, path: Path) -> None:
    """Raises FileExistsError if a file would be replaced by another one when a model is saved as a file at `path`."""
    names = (PLANES, GLASS, CAMERAS, *(() if model.scene.environment.is_empty else (ENVIRONMENT, PANORAMA)))
    is_splat = path.suffix.lower().removeprefix(".") in writing.SPLAT_WRITERS
    sidecars = [path.with_name(name) for name in names] if is_splat else []
    found = [str(target) for target in [path, *_differing_files(model, sidecars)] if target.exists()]
    if found:
        raise FileExistsError(
            f"{join_names(found)} already exists; nothing was written. Choose another folder; in Python, "
            "overwrite=True replaces files"
        )


def _differing_files(model: Model, sidecars: Sequence[Path]) -> list[Path]:
    """Existing files next to a splat file that differ from what the model would write."""
    there = [target for target in sidecars if target.exists()]
    if not there:
        return []
    with tempfile.TemporaryDirectory() as folder:
        own = [*write_sidecars(Path(folder), model.scene), Path(folder) / CAMERAS]
        write_cameras(own[-1], model.cameras.items())
        contents = {file.name: file.read_bytes() for file in own}
    if not len(model.scene.planes):  # Panes of an earlier model are removed; its glass stays, but is never read.
        contents[PLANES] = planes_json(model.scene.planes).encode()
        there = [target for target in there if target.name != GLASS or not (target.parent / PLANES).exists()]
    return [target for target in there if not target.is_file() or target.read_bytes() != contents.get(target.name)]


def unsaved_parts(model: Model, kind: str) -> list[str]:
    """Parts of a model that neither the splat file nor the files next to it can store."""
    scene = model.scene
    own, read = (recipe.renderer().page_settings() for recipe in (model.recipe, recipe_of_splats(scene.primary)))
    names = read if len(scene.planes) else ("background",)
    lost = [f"{name}={own[name]}" for name in names if name in own and own[name] != read[name]]
    is_exact, logs = kind in writing.EXACT_FORMATS, scene.primary.channels.get("log_intensity")
    if not is_exact and len(scene.planes) and logs is not None and bool(logs.any()):
        lost.append("the intensity of Gaussians in panes")
    if len(scene.surroundings) or not scene.environment.is_empty:
        lost.append("what glossy surfaces mirror")
    if not is_exact and scene.primary.are_discs:
        lost.append("that Gaussians are discs")
    return [*lost, "the photographer"] if len(scene.photographer) else lost


def save_page(model: Model, path: Path, title: str, *, sharing: web_page.Sharing = web_page.PRIVATE) -> None:
    """Writes the page that shows a model with live panes in any browser."""
    with convert_to_input_error():
        web_page.write_page(path, model.scene, model.renderer, tuple(model.viewpoints.items()), title, sharing=sharing)


def write_sidecars(folder: Path, scene: Scene) -> list[Path]:
    """Writes planes and glass, and the environment as a panorama with a description, if present; returns the files."""
    written = []
    if len(scene.planes):
        write_planes(folder / PLANES, scene.planes)
        write_gaussians(folder / GLASS, scene.glass)
        written += [folder / PLANES, folder / GLASS]
    if not scene.environment.is_empty:
        environment = scene.environment
        write_equirect(folder / PANORAMA, equirect_from_environment(environment, 2 * environment.size))
        description = {
            "image": PANORAMA,
            "projection": "equirectangular",
            "color": "sRGB",
            "up": "+z in the top row",
            "forward": "+x in the middle column, +y left of it",
            "region": environment.region,
        }
        writing.write_text(folder / ENVIRONMENT, json.dumps(description, indent=2) + "\n")
        written += [folder / ENVIRONMENT, folder / PANORAMA]
    return written


def write_as_run(folder: Path, model: Model) -> None:
    """Writes a model to a new or empty folder in the layout of a run; the recipe comes last, to mark the folder as
    complete. A scene from a run refers to the run's capture; any other records the path of the model, or what is
    recorded there.
    """
    writing.make_folder(folder)
    directory, source = RunDirectory(folder), model.path
    directory.export(model.scene, max({} if source is None else RunDirectory(source).scene_folders(), default=0))
    write_cameras(folder / CAMERAS, model.cameras.items())
    records = [] if source is None else [source / SETTINGS_FILE, RunDirectory(source).import_record]
    if record := next((file for file in records if file.is_file()), None):
        writing.write_text(folder / record.name, read_text(record))
    else:
        directory.record_origin(source)
    writing.write_text(folder / "recipe.json", recipe_to_json(model.recipe) + "\n")


def save_folder(model: Model, folder: Path, *, overwrite: bool = False) -> Path:
    """Writes a model in the layout of a run, with bit-identical float32 tensors; returns the folder.

    Raises:
        FileExistsError: the folder exists and is not a saved model to be overwritten; nothing was written.
        InputError: the model has no cameras, which the layout requires.
    """
    if not model.cameras:
        raise InputError(
            f"a model without cameras cannot be saved as the folder {folder}; give it some, such as those of "
            "`glassplat.Camera.look_at`, or save it as .ply"
        )
    if not os.path.lexists(folder) or (folder.is_dir() and not any(folder.iterdir())):
        write_as_run(folder, model)
        return folder
    is_saved = (folder / "recipe.json").is_file() and not RunDirectory(folder).checkpoint.is_file()
    if not (overwrite and is_saved):
        more = ", or overwrite=True" if is_saved else ""
        raise FileExistsError(
            f"{folder} already exists and is not empty; nothing was written. Choose a new folder{more}"
        )
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as temporary:
        write_as_run(Path(temporary) / "new", model)
        folder.rename(Path(temporary) / "old")
        (Path(temporary) / "new").rename(folder)
    return folder


AXES: dict[str, tuple[int, int, int]] = {
    "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1),
}  # fmt: skip
log = logging.getLogger(__name__)


def _read_panes(file: Path, planes_file: Path | None) -> Planes:
    sidecar = file.with_name(PLANES)
    if planes_file is None and not sidecar.is_file():
        if file.with_name(GLASS).is_file():
            log.warning("%s no longer has panes: next to it is %s, but no %s", file, GLASS, PLANES)
        return Planes.empty()
    if planes_file is None and file.stem != EXPORT_STEM:
        log.info("%s gets the panes of %s; move it to another folder if they are not its panes", file, sidecar)
    return read_planes(planes_file or sidecar)


def _read_glass(file: Path, planes: Planes, *, own: bool) -> Gaussians:
    """The glass stored next to the file, or an even sheet of Gaussians on each pane."""
    sidecar = file.with_name(GLASS)
    if not len(planes) or not own or not sidecar.is_file():
        return covering_glass(planes)
    glass, _ = select_drawable(read_gaussians(sidecar), sidecar)
    if "logit_mark" not in glass.channels:
        raise InputError(f"{sidecar} has no property logit_mark; expected glass as `glassplat export` writes it")
    return glass


def _read_or_place_cameras(file: Path, gaussians: Gaussians, up: Up) -> list[tuple[str, Camera]]:
    if up not in AXES:
        raise InputError(f"up is {up!r}; expected one of {', '.join(AXES)}")
    sidecar = file.with_name(CAMERAS)
    cameras = read_cameras(sidecar) if sidecar.is_file() else []
    return cameras or web_page.cameras_around(gaussians, torch.tensor(AXES[up], dtype=torch.float64))


def load(
    path: str | os.PathLike[str],
    *,
    device: DeviceName = "auto",
    planes: str | os.PathLike[str] | None = None,
    up: Up = "-y",
) -> Model:
    """Loads a trained run, a saved model, or a splat file of any program.

    `planes.json`, `glass.ply` and `cameras.json` next to a splat file are read, too, as written by `Model.save` and
    `glassplat export`.

    Args:
        path: a run's directory, a folder of `Model.save` or `glassplat export`, or a .ply, .spz, .glb, .splat, .sog or
                .ksplat.
        device: device of the tensors; `auto` uses an NVIDIA GPU if available.
        planes: planes.json with the panes of a splat file, written by hand or by `export`; by default the one next to
            it.
        up: up direction of a splat file without a cameras.json, from which cameras are placed.

    Raises:
        CudaUnavailableError: a GPU was requested, but cannot be used.
        InputError: the path is not a scene, cannot be read, or is a run and `planes` was given.
        FileNotFoundError: the path does not exist.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; expected {writing.LOADABLE}")
    source = writing.scene_source(path)
    if source.is_dir() and not (source / "recipe.json").is_file():
        raise InputError(f"{path} holds no scene; expected {writing.LOADABLE}. `glassplat.load_dataset` reads captures")
    if not source.is_dir():
        model = _from_file(source, device, None if planes is None else Path(planes), up)
        return model if source == path else replace(model, name=path.resolve().name)
    if planes is not None:
        raise InputError(f"{path} is no splat file, and has panes of its own or none; {planes} is for splat files")
    return _from_run(path, device)


def _from_run(path: Path, device: DeviceName) -> Model:
    directory = RunDirectory(path)
    recipe: Any = with_background(directory.recipe(), BLACK)  # Runs of earlier versions record none.
    scene, _ = directory.latest_scene()
    with convert_to_input_error():
        recipe.renderer().check(scene)
        cameras = read_cameras(path / CAMERAS)
    if not cameras:
        raise InputError(f"{path / CAMERAS} lists no camera; expected those of the photographs")
    return Model(scene.to(chosen_device(device)), recipe, name_cameras(cameras), path.resolve().name, path)


def _from_file(path: Path, device: DeviceName, planes_file: Path | None, up: Up) -> Model:
    """A model from a splat file, on black, with the files that `export` writes next to it."""
    with convert_to_input_error():
        gaussians, lost = select_drawable(read_splats(path), path)
        if not len(gaussians):
            raise InputError(f"{path} holds no Gaussians; expected a trained splat")
        planes = _read_panes(path, planes_file)
        own = planes_file is None or writing.real_path(planes_file) == writing.real_path(path.with_name(PLANES))
        glass = _read_glass(path, planes, own=own)
        cameras = _read_or_place_cameras(path, gaussians, up)
        centers = torch.stack([camera.center for _, camera in cameras])
        radius = float((centers - centers.mean(0)).norm(dim=1).max())
        # As for training; with a single camera, from the Gaussians.
        extent = captures.EXTENT_MARGIN * (radius or web_page.bounding_ball(gaussians)[1])
        scene = Scene(with_intensity(gaussians), extent, glass=glass, planes=planes)
    for warning in captures.far_origin_warnings(centers, extent):
        log.warning("%s: %s", path, warning)
    if lost:
        log.warning("%d Gaussians of %s are left out: they contain NaN or values too large to draw", lost, path)
    recipe = recipe_of_splats(scene.primary)
    return Model(scene.to(chosen_device(device)), recipe, name_cameras(cameras), path.stem, path)


def recipe_of_splats(gaussians: Gaussians) -> Any:
    """The recipe for a file's Gaussians: `planar` for ellipsoids, `splat` for discs, which do not support panes."""
    return SplatRecipe(background=BLACK, primitive="disc") if gaussians.are_discs else PlanarRecipe(background=BLACK)
