"""Glossy scenes with nearby reflected objects: a table full of objects, a sheet of metal, a car next to a wall."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tools.scene_draws import Body, Coating, DrawnScene, Shape, Stand
from tools.scene_environment import NAMED, Color
from tools.scene_surfaces import Triangles, placed, star_shaped

Array = NDArray[np.floating]
NearScene = Literal["table", "gold", "sheet", "car"]
NEAR_SCENES: tuple[NearScene, ...] = ("table", "gold", "sheet", "car")

BALL_RADIUS = 0.5
"""Radius of the mirror ball on the table."""
SHEET_SIZE = (1.5, 0.95)
"""Width and height of the sheet of metal, world units."""
SHEET_SWING = 0.16
"""Amplitude of the waves of the sheet."""
SHEET_THICKNESS = 0.02
CAR_HALF_AXES = np.array([0.72, 0.36, 0.27])
WALL = np.array([1.1, 0.05, 0.55])
"""Half sizes of the wall next to the car."""
WALL_Y = 0.8
COLORS: tuple[Color, ...] = (
    (0.72, 0.10, 0.06), (0.08, 0.35, 0.65), (0.75, 0.58, 0.08), (0.10, 0.48, 0.16), (0.62, 0.22, 0.52),
    (0.80, 0.80, 0.76),
)  # fmt: skip


def near_scene(name: NearScene) -> DrawnScene:
    """The scene of a name; reflective bodies come first."""
    bodies, stand = {"table": _table, "gold": _gold, "sheet": _sheet, "car": _car}[name]()
    return DrawnScene(bodies, stand, NAMED)


def _table() -> tuple[tuple[Body, ...], Stand]:
    """A mirror ball on a table, surrounded by six matte objects."""
    stand = Stand(radius=1.25, z=-BALL_RADIUS, checker_size=0.2, pattern_seed=1)
    ball = star_shaped(lambda d: BALL_RADIUS * np.ones(d.shape[:-1]))
    around = tuple(_standing(number, 0.92, 60.0 * number + 11.0, stand.z) for number in range(6))
    return (_body("ball", ball, "mirror", number=0), *around), stand


def _gold() -> tuple[tuple[Body, ...], Stand]:
    """The table with a golden ball instead of the mirror ball."""
    (mirror, *around), stand = _table()
    return (_body("ball", mirror.triangles, "metal", number=2), *around), stand


def _sheet() -> tuple[tuple[Body, ...], Stand]:
    """An upright wavy sheet of polished metal, with objects on both sides."""
    stand = Stand(radius=1.25, z=-0.5, checker_size=0.25, pattern_seed=5)
    sheet = placed(_waved_sheet(), np.eye(3), np.array([0.0, 0.0, stand.z + SHEET_SIZE[1] / 2]))
    # None in the plane of the sheet, y = 0.
    angles_deg = (50.0, 90.0, 135.0, 235.0, 270.0, 315.0)
    around = tuple(_standing(number, 0.72, angle, stand.z) for number, angle in enumerate(angles_deg))
    return (_body("box", sheet, "metal", number=5), *around), stand


def _car() -> tuple[tuple[Body, ...], Stand]:
    """A lacquered car-like body, next to a patterned wall and in front of two objects."""
    stand = Stand(radius=1.25, z=-0.4, checker_size=0.3, pattern_seed=7)
    body = star_shaped(lambda d: np.sum(np.abs(d / CAR_HALF_AXES) ** 3.0, axis=-1) ** (-1 / 3.0))
    body = placed(body, np.eye(3), np.array([0.0, 0.0, stand.z + CAR_HALF_AXES[2]]))
    wall = placed(_block(WALL), np.eye(3), np.array([0.0, WALL_Y, stand.z + WALL[2]]))
    things = tuple(_standing(n, 0.78, angle, stand.z) for n, angle in ((0, 235.0), (2, 300.0)))
    return (
        _body("box", body, "glaze", number=0, refraction=2.6),
        _body("box", wall, "patterned", number=3),
        *things,
    ), stand


def _standing(number: int, distance: float, angle_deg: float, ground_z: float) -> Body:
    """One of the matte objects, on the ground at a distance from the centre."""
    half_axes = np.array([(0.13, 0.13, 0.30), (0.18, 0.18, 0.18), (0.15, 0.15, 0.21)][number % 3])
    power = (2.0, 6.0, 2.0)[(number + 1) % 3]
    shape: Shape = "box" if power > 2 else "egg"
    mesh = star_shaped(lambda d: np.sum(np.abs(d / half_axes) ** power, axis=-1) ** (-1 / power), 96, 48)
    angle = np.radians(angle_deg)
    turn = Rotation.from_euler("z", 25.0 * number, degrees=True).as_matrix()
    place = np.array([distance * np.cos(angle), distance * np.sin(angle), ground_z - float(mesh.positions[:, 2].min())])
    return _body(shape, placed(mesh, turn, place), "patterned" if number % 2 else "matte", number=number)


def _body(shape: Shape, triangles: Triangles, coating: Coating, *, number: int, refraction: float = 1.5) -> Body:
    return Body(shape, triangles, coating, COLORS[number % len(COLORS)], refraction, pattern_seed=20 + 2 * number)


def _waved_sheet(columns: int = 240, rows: int = 24) -> Triangles:
    """A thin closed sheet about the origin, with y a sine of x; z is up."""
    width, height = SHEET_SIZE
    x = width * (np.arange(columns + 1) / columns - 0.5)
    z = height * (np.arange(rows + 1) / rows - 0.5)
    wave = 2 * np.pi / width
    middle, slope = SHEET_SWING * np.sin(wave * x), SHEET_SWING * wave * np.cos(wave * x)
    normal = np.stack([-slope, np.ones_like(x), np.zeros_like(x)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sides = []
    for side in (1.0, -1.0):
        line = np.stack([x, middle, np.zeros_like(x)], axis=1) + side * SHEET_THICKNESS / 2 * normal
        positions = line[:, None] + np.array([0.0, 0.0, 1.0]) * z[None, :, None]
        normals = np.broadcast_to(side * normal[:, None], positions.shape)
        faces = _grid_faces(columns, rows)
        sides.append((positions.reshape(-1, 3), normals.reshape(-1, 3), faces if side < 0 else faces[:, ::-1]))
    count = len(sides[0][0])
    u, v = np.meshgrid(x / width + 0.5, z / height + 0.5, indexing="ij")
    coordinates = np.stack([u, v], axis=-1).reshape(-1, 2)
    return Triangles(
        positions=np.concatenate([side[0] for side in sides]),
        normals=np.concatenate([side[1] for side in sides]),
        coordinates=np.concatenate([coordinates, coordinates]),
        faces=np.concatenate([sides[0][2], sides[1][2] + count]),
    )


def _block(half_sizes: Array) -> Triangles:
    """A box about the origin, each face of which shows the whole texture."""
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    positions, normals = [], []
    for axis in range(3):
        for side in (1.0, -1.0):
            # Counter-clockwise seen from +axis; reversed for the other side.
            face = np.zeros((4, 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, *corners[:: int(side)].T
            positions.append(face * half_sizes)
            normals.append(np.tile(side * np.eye(3)[axis], (4, 1)))
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(6)[:, None, None] + halves).reshape(-1, 3)
    return Triangles(np.concatenate(positions), np.concatenate(normals), np.tile((corners + 1) / 2, (6, 1)), faces)


def _grid_faces(columns: int, rows: int) -> NDArray[np.int64]:
    """Two triangles per grid cell, [2 columns rows, 3]; they face -y if columns run to +x and rows to +z."""
    corner = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    beside, above = corner + rows + 1, corner + 1
    return np.concatenate([np.stack([corner, beside, beside + 1], -1), np.stack([corner, beside + 1, above], -1)])
