"""Controls in the browser: panes, cleaning, measuring, keyframes of a video, photographs."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any

import numpy as np
import torch

from glassplat.options import Cleaning
from glassplat.publish.camera_paths import interpolate_cameras
from glassplat.publish.cleaning import Floaters
from glassplat.render.layers import LABEL_COLORS
from glassplat.scene.camera import Camera
from glassplat.scene.panes import Planes
from glassplat.scene.scene import PaneMove
from glassplat.viewer.drawing import LEAST_GAIN, MOST_GAIN, ViewerState, ViewRequest, matrix_of, wxyz_of

log = logging.getLogger(__name__)


def log_errors(callback: Callable[..., Any]) -> Callable[..., None]:
    """Wraps a callback to log its errors, which would print tracebacks in viser's threads and stop a training run."""

    @wraps(callback)
    def call(*arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception as error:  # noqa: BLE001 - A client must not stop the server or the other clients.
            log.warning("a request of a browser failed: %s: %s", type(error).__name__, error)

    return call


NO_PANE = "none"
HANDLE_SHARE = 0.7
"""Length of a gizmo's arrows, as a share of the mean half side of its pane."""
OUTLINE_PIXELS = 2.0
MOST_OPEN = 4
"""Maximum number of panes whose sliders are unfolded initially."""


class PaneGizmo:
    """Arrows and arcs that move and rotate one pane, with its outline.

    Attributes:
        label: of the pane.
        handle: viser's gizmo, hidden at first; its position applies in both cases.
    """

    def __init__(self, scene: Any, planes: Planes, row: int) -> None:
        """Adds the gizmo at the position of the pane.

        Args:
            scene: viser's scene of a client.
            planes: of the displayed scene.
            row: index of the pane.
        """
        self.label, name = planes.labels[row], f"/panes/{planes.labels[row]}"
        axes = torch.stack([*(axis[row] for axis in planes.axes()), planes.normals[row]], dim=1)
        self._start = wxyz_of(axes.detach().double().cpu().numpy())
        self._center = planes.centers[row].detach().double().cpu().numpy()
        half = planes.half_sizes[row].detach().double().cpu().numpy()
        self.handle = scene.add_transform_controls(
            name,
            scale=HANDLE_SHARE * float(half.mean()),
            wxyz=self._start,
            position=self._center,
            depth_test=False,
            visible=False,
        )
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0]
        scene.add_line_segments(
            f"{name}/outline",
            np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).astype(np.float32),
            LABEL_COLORS[row % len(LABEL_COLORS)],
            thickness=OUTLINE_PIXELS,
            thickness_units="screen",
        )

    def reset(self) -> None:
        """Resets the gizmo to the pane's original pose."""
        self.handle.wxyz, self.handle.position = self._start, self._center

    def pane_move(self) -> PaneMove | None:
        """Movement of the pane; None if it was not moved."""
        wxyz, position = np.asarray(self.handle.wxyz), np.asarray(self.handle.position)
        if np.array_equal(wxyz, self._start) and np.array_equal(position, self._center):
            return None
        rotation = np.array([1.0, 0, 0, 0])
        if not np.array_equal(wxyz, self._start):
            rotation = wxyz_of(matrix_of(wxyz) @ matrix_of(self._start).T)
        return PaneMove(self.label, tuple(rotation.tolist()), tuple((position - self._center).tolist()))


class PaneControls:
    """A folder of controls for the panes; only for scenes with at least one."""

    def __init__(self, handle: Any, planes: Planes, order: float | None = None) -> None:
        """Lays out the controls; `listen` activates them.

        Args:
            handle: of the client.
            planes: of the displayed scene; at least one.
            order: of the folder among the client's controls; by default, the last.
        """
        gui = handle.gui
        self._initial_reflectances = dict(zip(planes.labels, planes.base_reflectances.tolist(), strict=True))
        self._gizmos = [PaneGizmo(handle.scene, planes, row) for row in range(len(planes))]
        self._folder = gui.add_folder("Glass", order=order)
        with self._folder:
            self._glass = gui.add_dropdown("Panes", ("as it is", "mirror", "none"))
            with gui.add_folder("Reflectance R0", expand_by_default=len(planes) <= MOST_OPEN):
                self._reflectances = {
                    label: gui.add_slider(f"Pane {label}", 0.0, 1.0, 0.005, round(value, 3))
                    for label, value in self._initial_reflectances.items()
                }
            self._gain = gui.add_slider("Gain", LEAST_GAIN, MOST_GAIN, 0.05, 1.0)
            self._chosen = gui.add_dropdown("Move pane", (NO_PANE, *map(str, planes.labels)))
            self._reset_button = gui.add_button("Reset panes")

    def listen(self, changed: Callable[[], None]) -> None:
        """Calls `changed` whenever the request changes, and shows the gizmo of the selected pane."""
        handles = (gizmo.handle for gizmo in self._gizmos)
        for control in (self._glass, *self._reflectances.values(), self._gain, *handles):
            control.on_update(log_errors(lambda _: changed()))
        self._chosen.on_update(log_errors(lambda _: self._show_gizmo()))
        self._reset_button.on_click(log_errors(lambda _: self._reset(changed)))

    def apply(self, request: ViewRequest) -> ViewRequest:
        """The request, with the edits of panes from the controls."""
        sliders = {label: clamp(slider.value, 0.0, 1.0) for label, slider in self._reflectances.items()}
        initial = self._initial_reflectances
        changed = [(label, value) for label, value in sliders.items() if value != round(initial[label], 3)]
        moves = [move for gizmo in self._gizmos if (move := gizmo.pane_move()) is not None]
        return replace(
            request,
            glass=self._glass.value,
            reflectances=tuple(changed),
            gain=clamp(self._gain.value, LEAST_GAIN, MOST_GAIN),
            moves=tuple(moves),
        )

    def remove(self) -> None:
        """Removes the controls, and the gizmos from the view."""
        self._folder.remove()
        for gizmo in self._gizmos:
            gizmo.handle.remove()

    def _show_gizmo(self) -> None:
        for gizmo in self._gizmos:
            gizmo.handle.visible = str(gizmo.label) == self._chosen.value

    def _reset(self, changed: Callable[[], None]) -> None:
        for gizmo in self._gizmos:
            gizmo.reset()
        changed()


def clamp(value: float, least: float, most: float) -> float:
    """The value of a client clamped to a range; NaN becomes the minimum."""
    return min(max(value, least), most) if value == value else least


MOST_ISOLATED, MOST_OVERSIZED = 40.0, 4.0
BOX_HINT = "x y z x y z"


class CleanControls:
    """A folder of controls that remove floaters, like `glassplat clean`."""

    def __init__(self, gui: Any, state: ViewerState) -> None:
        """Lays out the controls; `listen` activates them.

        Args:
            gui: of the client.
            state: the displayed scene.
        """
        self._state, usual = state, Cleaning()
        self._floaters: Floaters | None = None
        with gui.add_folder("Clean", expand_by_default=False):
            self._enabled = gui.add_checkbox("Remove floaters", False)
            self._isolated = gui.add_slider("Isolated", 0.0, MOST_ISOLATED, 0.5, usual.isolated)
            self._oversized = gui.add_slider("Oversized", 0.0, MOST_OVERSIZED, 0.05, usual.oversized)
            self._box = gui.add_text("Box", "", hint=BOX_HINT)
            self._message = gui.add_markdown("")

    def listen(self, changed: Callable[[], None]) -> None:
        """Calls `changed` whenever the request changes."""
        for control in (self._enabled, self._isolated, self._oversized, self._box):
            control.on_update(log_errors(lambda _: changed()))

    def apply(self, request: ViewRequest) -> ViewRequest:
        """The request, with the mask of Gaussians that the controls keep."""
        if not self._enabled.value:
            self._message.content = ""
            return request
        primary = self._state.scene.primary
        if self._floaters is None:
            self._floaters = Floaters(primary, torch.stack([camera.center for _, camera in self._state.cameras]))
        cleaning = Cleaning(
            parse_box(self._box.value),
            clamp(self._isolated.value, 0.0, MOST_ISOLATED),
            clamp(self._oversized.value, 0.0, MOST_OVERSIZED),
        )
        kept = ~torch.stack(list(self._floaters.masks(cleaning).values())).any(dim=0)
        self._message.content = f"{int(kept.sum())} of {len(primary)} Gaussians kept"
        return replace(request, kept=kept) if bool(kept.any()) else request


def parse_box(text: str) -> tuple[float, float, float, float, float, float] | None:
    """Two corners of a box, parsed from text; None unless it consists of six finite numbers."""
    try:
        x, y, z, u, v, w = (float(number) for number in text.replace(",", " ").split())
    except ValueError:
        return None
    return (x, y, z, u, v, w) if np.isfinite([x, y, z, u, v, w]).all() else None


MEASURE_COLOR = (86, 180, 233)


class MeasureControls:
    """A checkbox, and the distance between the last two points clicked while it is checked."""

    def __init__(self, handle: Any, clicked: Callable[[np.ndarray], None]) -> None:
        """Lays out the controls; `clicked` is called with the direction [3] of each click."""
        self._handle = handle
        self._points: list[np.ndarray] = []
        self._is_listening = False
        with handle.gui.add_folder("Measure", expand_by_default=False):
            self._enabled = handle.gui.add_checkbox("Click two points", False)
            self._message = handle.gui.add_markdown(self._distance())
        self._enabled.on_update(log_errors(lambda _: self._listen_to_clicks(clicked)))

    def add_point(self, point: np.ndarray) -> None:
        """Adds a point [3]; a third one starts a new measurement."""
        self._points = [*self._points, point] if len(self._points) < 2 else [point]
        self._message.content = self._distance()
        ends = np.stack([self._points[0], self._points[-1]]).astype(np.float32)
        self._handle.scene.add_line_segments(
            "/measured", ends[None], MEASURE_COLOR, thickness=3.0, thickness_units="screen"
        )

    def _listen_to_clicks(self, clicked: Callable[[np.ndarray], None]) -> None:
        """Listens to clicks once the checkbox is first checked, because pages that report clicks look different."""
        if not self._enabled.value or self._is_listening:
            return
        self._is_listening = True
        register = self._handle.scene.on_click()
        register(log_errors(lambda event: clicked(np.array(event.ray_direction)) if self._enabled.value else None))

    def _distance(self) -> str:
        if len(self._points) < 2:
            return f"{len(self._points)} of 2 points"
        ends = " ".join(f"{value:.4g}" for point in self._points for value in point)
        return (
            f"{np.linalg.norm(self._points[1] - self._points[0]):.4g} units; to convert to metres: "
            f"`glassplat clean ... --scale {ends} METRES`"
        )


MOST_KEYFRAMES = 200
FRUSTUM_SHARE = 0.06
"""Size of a keyframe's frustum, as a share of the scene's extent."""
PLAYED_PER_SECOND, SECONDS_BETWEEN = 8, 2
KEYFRAME_COLOR = (249, 140, 10)


class KeyframeControls:
    """A folder of controls, and the keyframes, shown as frusta in the view."""

    def __init__(
        self,
        handle: Any,
        extent: float,
        camera: Callable[[], Camera | None],
        move_camera: Callable[[Camera], None],
        save: Callable[[str], None] | None,
    ) -> None:
        """Lays out the controls.

        Args:
            handle: of the client.
            extent: of the scene, world units.
            camera: returns the client's current camera, None while unknown.
            move_camera: moves the client's camera.
            save: writes the keyframes under a name; None if writing is not allowed.
        """
        self._handle, self._extent, self._camera = handle, extent, camera
        self._frusta: list[Any] = []
        self.keyframes: tuple[Camera, ...] = ()
        self._playing: threading.Event | None = None
        # viser calls the callbacks of quick successive clicks concurrently.
        self._lock = threading.Lock()
        self._move_lock = threading.Lock()
        gui = handle.gui
        with gui.add_folder("Keyframes", expand_by_default=False):
            self._count = gui.add_markdown(self._count_text())
            gui.add_button("Add this view").on_click(log_errors(lambda _: self.add()))
            gui.add_button("Remove last").on_click(log_errors(lambda _: self.remove()))
            gui.add_button("Play or stop").on_click(log_errors(lambda _: self.play(move_camera)))
            if save is not None:
                name = gui.add_text("Name", "keyframes")
                gui.add_button("Save keyframes").on_click(log_errors(lambda _: save(name.value)))

    def add(self) -> None:
        """Adds a keyframe at the client's camera."""
        camera = self._camera()
        with self._lock:
            if camera is None or len(self._frusta) == MOST_KEYFRAMES:
                return
            frustum = self._handle.scene.add_camera_frustum(
                f"/keyframes/{len(self._frusta)}",
                2 * float(np.arctan(camera.height / 2 / camera.fy)),
                camera.width / camera.height,
                scale=FRUSTUM_SHARE * self._extent,
                thickness=2.0,
                thickness_units="screen",
                color=KEYFRAME_COLOR,
                wxyz=wxyz_of(camera.cam_from_world[:3, :3].double().numpy().T),
                position=camera.center.double().numpy(),
            )
            self._frusta.append(frustum)
            self.keyframes = (*self.keyframes, camera)
            self._count.content = self._count_text()

    def remove(self) -> None:
        """Removes the last keyframe."""
        with self._lock:
            if self._frusta:
                self._frusta.pop().remove()
                self.keyframes = self.keyframes[:-1]
                self._count.content = self._count_text()

    def play(self, move_camera: Callable[[Camera], None]) -> None:
        """Starts or stops moving the client along the path of the video."""
        keyframes = self.keyframes
        with self._lock:
            was_playing = self._playing is not None and not self._playing.is_set()
            self.stop()
            if was_playing or len(keyframes) < 2:
                return
            ended = self._playing = threading.Event()
        frames = (len(keyframes) - 1) * SECONDS_BETWEEN * PLAYED_PER_SECOND + 1
        # A separate thread, because viser has few, and all clients share them.
        path = interpolate_cameras(keyframes, frames)
        threading.Thread(target=_play, args=(path, move_camera, ended, self._move_lock), daemon=True).start()

    def stop(self) -> None:
        """Stops playback, for example when the client leaves; the camera does not move after this returns."""
        with self._move_lock:
            if self._playing is not None:
                self._playing.set()

    def _count_text(self) -> str:
        count = len(self.keyframes)
        return f"{count} {'keyframe' if count == 1 else 'keyframes'}" + (", a video needs two" if count < 2 else "")


def _play(path: list[Camera], move: Callable[[Camera], None], ended: threading.Event, lock: threading.Lock) -> None:
    """Moves along a path until its end or until playback stops; `lock` is held during each move."""
    for camera in path:
        with lock:
            if ended.is_set():
                return
            move(camera)
        if ended.wait(1 / PLAYED_PER_SECOND):
            return
    ended.set()


PHOTO_WIDTH = 360
NO_PHOTOGRAPH = np.zeros((2, 3, 3), dtype=np.uint8)


class PhotographControls:
    """A folder of controls: a list of photographs whose cameras can be selected, and the nearest photograph."""

    def __init__(self, gui: Any, state: ViewerState, initial: int) -> None:
        """Lays out the controls; `listen` activates them.

        Args:
            gui: of the client.
            state: the displayed scene.
            initial: index of the initial photograph.
        """
        self._state, self._current, self._shown = state, initial, -1
        self._names = tuple(name for name, _ in state.cameras)
        with gui.add_folder("Photographs"):
            self._name = gui.add_dropdown("Go to", self._names, initial_value=self._names[initial])
            self._steps = gui.add_button_group("Step", ("previous", "next"))
            self._photo = None
            if state.photographs:
                self._photo = gui.add_image(NO_PHOTOGRAPH, label="Nearest photograph")

    def listen(self, go_to: Callable[[int], None]) -> None:
        """Calls `go_to` with the index of the selected photograph, which moves the camera there."""
        names, steps = self._names, self._steps
        self._name.on_update(
            log_errors(lambda event: go_to(names.index(self._name.value)) if event.client is not None else None)
        )
        steps.on_click(log_errors(lambda _: go_to((self._current + (1 if steps.value == "next" else -1)) % len(names))))

    def mark_current(self, index: int) -> None:
        """Marks a photograph as the one at whose pose the camera is."""
        self._current = index
        self._name.value = self._state.cameras[index][0]

    def show_nearest(self, index: int) -> None:
        """Shows a photograph unless it is displayed already; the label reports unreadable ones."""
        cameras = self._state.cameras
        if torch.equal(cameras[index][1].cam_from_world, cameras[self._current][1].cam_from_world):
            index = self._current  # Of photographs with equal poses, the selected one.
        name = cameras[index][0]
        if self._photo is None or index == self._shown or name not in self._state.photographs:
            return
        self._current = self._shown = index
        try:
            photo = self._state.photographs[name]()
        except (OSError, ValueError) as error:
            self._photo.image = NO_PHOTOGRAPH
            self._photo.label = f"Nearest photograph: {name} cannot be read ({error})"
            return
        step = max(1, photo.shape[1] // PHOTO_WIDTH)
        self._photo.image = photo[::step, ::step].numpy()
        self._photo.label = f"Nearest photograph: {name}"
