"""The controls of the panes: what becomes of the glass, how much each reflects, and where it stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from glassplat.evaluate.colormap import LABEL_COLORS
from glassplat.scene.plane import Planes
from glassplat.viewer.callbacks import survived
from glassplat.viewer.drawing import LEAST_GAIN, MOST_GAIN, PaneMove, Wish
from glassplat.viewer.rotations import matrix_of, wxyz_of

NO_PANE = "none"
HANDLE_SHARE = 0.7
"""Length of a gizmo's arrows, of the mean half side of its pane."""
OUTLINE_PIXELS = 2.0


class PaneGizmo:
    """Arrows and arcs on one pane that move and turn it, with its outline; hidden until it is shown."""

    def __init__(self, scene: Any, planes: Planes, row: int) -> None:
        """Puts it where the pane is.

        Args:
            scene: a client's.
            planes: of the scene that is looked at.
            row: which of them.
        """
        self.label, self._name = planes.labels[row], f"/panes/{planes.labels[row]}"
        axes = torch.stack([*(axis[row] for axis in planes.axes()), planes.normals[row]], dim=1)
        self._start = wxyz_of(axes.detach().double().cpu().numpy())
        self._center = planes.centers[row].detach().double().cpu().numpy()
        half = planes.half_sizes[row].detach().double().cpu().numpy()
        self._handle = scene.add_transform_controls(
            self._name,
            scale=HANDLE_SHARE * float(half.mean()),
            wxyz=self._start,
            position=self._center,
            depth_test=False,
            visible=False,
        )
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0]
        scene.add_line_segments(
            f"{self._name}/outline",
            np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).astype(np.float32),
            LABEL_COLORS[row % len(LABEL_COLORS)],
            thickness=OUTLINE_PIXELS,
            thickness_units="screen",
        )

    def listen(self, changed: Callable[[], None]) -> None:
        """From now on `changed` is called whenever it is moved."""
        self._handle.on_update(survived(lambda _: changed()))

    def show(self, visible: bool) -> None:
        """Shows or hides it; where it stands counts in either case."""
        self._handle.visible = visible

    def put_back(self) -> None:
        """Back to where the pane is in the scene."""
        self._handle.wxyz, self._handle.position = self._start, self._center

    def remove(self) -> None:
        """Takes it and its outline off the view."""
        self._handle.remove()

    def move(self) -> PaneMove | None:
        """How it was moved; None if it was not."""
        wxyz, position = np.asarray(self._handle.wxyz), np.asarray(self._handle.position)
        if np.array_equal(wxyz, self._start) and np.array_equal(position, self._center):
            return None
        turn = np.array([1.0, 0, 0, 0])
        if not np.array_equal(wxyz, self._start):
            turn = wxyz_of(matrix_of(wxyz) @ matrix_of(self._start).T)
        return PaneMove(self.label, tuple(turn.tolist()), tuple((position - self._center).tolist()))


class PaneControls:
    """A folder of controls of the glass; to be made only for scenes that have panes."""

    def __init__(self, handle: Any, planes: Planes) -> None:
        """Lays them out; they do nothing yet.

        Args:
            handle: of the client.
            planes: of the scene that is looked at; at least one.
        """
        gui = handle.gui
        self._own = dict(zip(planes.labels, planes.base_reflectances.tolist(), strict=True))
        self._gizmos = [PaneGizmo(handle.scene, planes, row) for row in range(len(planes))]
        with gui.add_folder("Glass"):
            self._glass = gui.add_dropdown("Panes", ("as it is", "mirror", "none"))
            self._reflectances = {
                label: gui.add_slider(f"R0 of pane {label}", 0.0, 1.0, 0.005, round(value, 3))
                for label, value in self._own.items()
            }
            self._gain = gui.add_slider("Gain", LEAST_GAIN, MOST_GAIN, 0.05, 1.0)
            self._chosen = gui.add_dropdown("Move pane", (NO_PANE, *map(str, planes.labels)))
            self._back = gui.add_button("Put panes back")

    def listen(self, changed: Callable[[], None]) -> None:
        """From now on `changed` is called whenever something else is wished for, and arrows show as they are chosen."""
        for control in (self._glass, *self._reflectances.values(), self._gain):
            control.on_update(survived(lambda _: changed()))
        for gizmo in self._gizmos:
            gizmo.listen(changed)
        self._chosen.on_update(survived(lambda _: self._show_gizmo()))
        self._back.on_click(survived(lambda _: self._put_back(changed)))

    def applied(self, wish: Wish) -> Wish:
        """The wish, with the panes as the controls say."""
        sliders = {label: within(slider.value, 0.0, 1.0) for label, slider in self._reflectances.items()}
        changed = [(label, value) for label, value in sliders.items() if value != round(self._own[label], 3)]
        moves = [move for gizmo in self._gizmos if (move := gizmo.move()) is not None]
        return replace(
            wish,
            glass=self._glass.value,
            reflectances=tuple(changed),
            gain=within(self._gain.value, LEAST_GAIN, MOST_GAIN),
            moves=tuple(moves),
        )

    def remove(self) -> None:
        """Takes the gizmos off the view; the controls go with their layout."""
        for gizmo in self._gizmos:
            gizmo.remove()

    def _show_gizmo(self) -> None:
        for gizmo in self._gizmos:
            gizmo.show(str(gizmo.label) == self._chosen.value)

    def _put_back(self, changed: Callable[[], None]) -> None:
        for gizmo in self._gizmos:
            gizmo.put_back()
        changed()


def within(value: float, least: float, most: float) -> float:
    """The value within a range, which a client need not keep to; the least where it is no number."""
    return min(max(value, least), most) if value == value else least
