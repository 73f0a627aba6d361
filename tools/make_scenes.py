"""Renders small scenes of reflective objects under a known environment with Mitsuba 3.

    pip install -e '.[scenes]'
    python -m tools.make_scenes --output runs/reflective --scenes ball torus control
    python -m tools.make_scenes --output runs/drawn --seed 1 2 3

docs/scenes.md describes the scenes and their files.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

from glassplat.captures.transforms import points_in_box
from glassplat.captures.view import NORMALS_FOLDER
from glassplat.files.ply_table import write_table
from tools.estimated_normals import estimated_normals
from tools.scene_draws import MATTE, Body, DrawnScene, draw_scene
from tools.scene_environment import make_environment
from tools.scene_near import NEAR_SCENES, NearScene, near_scene
from tools.scene_surfaces import Triangles, ball_texture, disc, ground_texture, torus, torus_depth

StudioName = Literal["ball", "torus", "control"]
SceneName = Literal[StudioName, NearScene]
NAMES: tuple[SceneName, ...] = ("ball", "torus", "control", *NEAR_SCENES)
Variant = Literal["llvm_ad_rgb", "cuda_ad_rgb"]
Array = NDArray[np.floating]

CAMERA_DISTANCE = 4.0
"""Distance of every camera from `LOOKED_AT`, world units."""
CAMERA_ANGLE_X_RAD = 0.6911
"""Opening angle of the NeRF-synthetic cameras."""
LOOKED_AT = np.array([0.0, 0.0, -0.15])
ELEVATIONS_DEG = (8.0, 75.0)
"""Smallest and largest elevation of cameras above the horizontal through `LOOKED_AT`."""
GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
TEST_AZIMUTH_RAD = 1.0
"""Rotation between the spirals of the test and the training cameras."""

BALL_RADIUS = 0.7
TORUS_MAJOR, TORUS_MINOR = 0.58, 0.25
TORUS_TILT_DEG = 40.0
TORUS_COLOR = (0.34, 0.02, 0.04)
TORUS_REFRACTION = 2.5
"""Refractive index of the coating: it reflects 18 % at normal incidence, far more than lacquer."""
GROUND_RADIUS = 1.2
TEXTURE_SIZE = 1024
BOUNCES = 6
SUBPIXELS = 8
"""Rays per pixel and axis for normals, coverage and strength."""
MITSUBA_FROM_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])
WORLD_FROM_MITSUBA_SKY = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Environment maps in Mitsuba have +y up, +z in the centre column and +x a quarter from the left."""


@dataclass(frozen=True)
class Arguments:
    """Options of path-traced scenes of reflective objects, with true normals, strength and environment."""

    output: Path
    """Folder in which one folder per scene is created; these must not exist yet."""
    scenes: tuple[SceneName, ...] = ()
    """Named scenes to make; all of them if no seed is given either."""
    seed: tuple[int, ...] = ()
    """Seeds of random scenes to make, each named after its seed."""
    size: int = 256
    """Width and height of the images, pixels."""
    train: int = 80
    """Training views."""
    test: int = 16
    """Test views."""
    samples: int = 256
    """Light paths per pixel."""
    points: int = 0
    """Random grey points to write next to the images; 0 leaves them to the loader (glassplat: 100,000)."""
    environment_height: int = 512
    """Height of the equirectangular environment, pixels."""
    estimated_normals: float | None = None
    """Also write simulated monocular normals of the training views, with this mean error in degrees."""
    variant: Variant = "llvm_ad_rgb"
    """Mitsuba's backend: CPU or NVIDIA GPU."""


@dataclass(frozen=True)
class Studio:
    """A Mitsuba scene, of whose shapes the first `mirrors` count as reflective."""

    mitsuba: Any
    scene: Any
    mirrors: int
    size: int

    def shows_mirror(self, hits: Any) -> Array:
        """Mask of the hits [R] on reflective shapes, as 0 and 1."""
        # Shapes are found by their index, because Mitsuba may copy them while building the scene.
        shapes = self.scene.shapes()[: self.mirrors]
        return sum((np.array(hits.shape == shape, dtype=np.float64) for shape in shapes), np.zeros(1))


def camera_positions(count: int, azimuth_rad: float) -> Array:
    """Points [count, 3] on a spiral that climbs the hemisphere around `LOOKED_AT`, evenly over its area."""
    lowest, highest = np.sin(np.radians(ELEVATIONS_DEG))
    up = lowest + (highest - lowest) * (np.arange(count) + 0.5) / count
    azimuth = azimuth_rad + GOLDEN_ANGLE_RAD * np.arange(count)
    across = np.sqrt(1 - up**2)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=1)
    return LOOKED_AT + CAMERA_DISTANCE * directions


def world_from_opengl(position: Array, target: Array = LOOKED_AT) -> Array:
    """Pose [4, 4] of a camera at `position` [3] that looks at `target` [3]: +x right, +y up, -z forward."""
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
    return pose


def textured(mitsuba: Any, reflectance: Array) -> dict[str, Any]:
    """A diffuse material with a texture of linear reflectances [H, W, 3]."""
    bitmap = mitsuba.Bitmap(np.ascontiguousarray(reflectance, dtype=np.float32))
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}


def mesh(mitsuba: Any, triangles: Triangles, material: Mapping[str, Any]) -> Any:
    """A Mitsuba mesh with one material."""
    properties = mitsuba.Properties()
    properties["mesh_bsdf"] = mitsuba.load_dict(dict(material))
    shape = mitsuba.Mesh(
        "mesh",
        vertex_count=len(triangles.positions),
        face_count=len(triangles.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mitsuba.traverse(shape)
    parameters["vertex_positions"] = triangles.positions.astype(np.float32).ravel()
    parameters["vertex_normals"] = triangles.normals.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = triangles.coordinates.astype(np.float32).ravel()
    parameters["faces"] = triangles.faces.astype(np.uint32).ravel()
    parameters.update()
    return shape


def make_body(mitsuba: Any, name: StudioName) -> tuple[Any, float]:
    """The object of a named scene, about the origin, and the height of the ground below it."""
    if name == "torus":
        coated = {
            "type": "plastic",
            "int_ior": TORUS_REFRACTION,
            "diffuse_reflectance": {"type": "rgb", "value": list(TORUS_COLOR)},
        }
        body = mesh(mitsuba, torus(TORUS_MAJOR, TORUS_MINOR, TORUS_TILT_DEG), coated)
        return body, -torus_depth(TORUS_MAJOR, TORUS_MINOR, TORUS_TILT_DEG)
    perfect_mirror = {"type": "conductor", "material": "none"}
    material = perfect_mirror if name == "ball" else textured(mitsuba, ball_texture(TEXTURE_SIZE))
    return mitsuba.load_dict({"type": "sphere", "radius": BALL_RADIUS, "bsdf": material}), -BALL_RADIUS


def make_drawn_body(mitsuba: Any, body: Body) -> Any:
    """One body of a random scene."""
    tint = {"type": "rgb", "value": list(body.tint)}
    if body.coating == "mirror":
        material: dict[str, Any] = {"type": "conductor", "material": "none"}
    elif body.coating == "matte":
        material = {"type": "diffuse", "reflectance": tint}
    elif body.coating == "patterned":
        material = textured(mitsuba, ball_texture(TEXTURE_SIZE, seed=body.pattern_seed))
    elif body.coating == "metal":
        # A metal reflects more than half of the light, whatever its colour.
        value = [0.5 + channel / 2 for channel in body.tint]
        material = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": value}}
    else:
        pattern = textured(mitsuba, ball_texture(TEXTURE_SIZE, seed=body.pattern_seed))["reflectance"]
        color = tint if body.coating == "glaze" else pattern
        material = {"type": "plastic", "int_ior": body.refraction, "diffuse_reflectance": color}
    return mesh(mitsuba, body.triangles, material)


def make_studio(mitsuba: Any, name: StudioName, environment: Array, size: int) -> Studio:
    """A named scene: object, ground and environment."""
    body, ground_z = make_body(mitsuba, name)
    ground = mesh(
        mitsuba, disc(GROUND_RADIUS, ground_z), textured(mitsuba, ground_texture(GROUND_RADIUS, TEXTURE_SIZE))
    )
    return assembled(mitsuba, (body,), ground, environment, mirrors=0 if name == "control" else 1, size=size)


def make_drawn_studio(mitsuba: Any, drawn: DrawnScene, environment: Array, size: int) -> Studio:
    """A random scene: its bodies, stand and environment."""
    stand = drawn.stand
    picture = ground_texture(stand.radius, TEXTURE_SIZE, checker_size=stand.checker_size, seed=stand.pattern_seed)
    ground = mesh(mitsuba, disc(stand.radius, stand.z), textured(mitsuba, picture))
    bodies = tuple(make_drawn_body(mitsuba, body) for body in drawn.bodies)
    mirrors = sum(body.coating not in MATTE for body in drawn.bodies)
    return assembled(mitsuba, bodies, ground, environment, mirrors=mirrors, size=size)


def assembled(
    mitsuba: Any, bodies: tuple[Any, ...], ground: Any, environment: Array, *, mirrors: int, size: int
) -> Studio:
    """A scene of bodies (the first `mirrors` reflect), ground and environment, which is transparent in images."""
    sky = {
        "type": "envmap",
        "bitmap": mitsuba.Bitmap(np.ascontiguousarray(environment)),
        "to_world": mitsuba.ScalarTransform4f(WORLD_FROM_MITSUBA_SKY),
    }
    tracer = {"type": "path", "max_depth": BOUNCES, "hide_emitters": True}
    shapes = {f"body{number}": body for number, body in enumerate(bodies)} | {"ground": ground}
    scene = mitsuba.load_dict({"type": "scene", "integrator": tracer, **shapes, "sky": sky})
    return Studio(mitsuba, scene, mirrors, size)


def make_sensor(studio: Studio, pose: Array, samples: int) -> Any:
    """A pinhole camera at `pose`, camera-to-world in OpenGL axes, whose pixels average over their square."""
    film = {
        "type": "hdrfilm",
        "width": studio.size,
        "height": studio.size,
        "pixel_format": "rgba",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return studio.mitsuba.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(CAMERA_ANGLE_X_RAD),
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 100.0,
            "to_world": studio.mitsuba.ScalarTransform4f(pose @ MITSUBA_FROM_OPENGL),
            "film": film,
            "sampler": {"type": "multijitter", "sample_count": samples},
        }
    )


def photograph(studio: Studio, pose: Array, samples: int, seed: int) -> NDArray[np.uint8]:
    """One view [S, S, 4]: sRGB and coverage, with straight (not premultiplied) colours."""
    sensor = make_sensor(studio, pose, samples)
    linear = np.array(studio.mitsuba.render(studio.scene, sensor=sensor, spp=samples, seed=seed), dtype=np.float64)
    alpha = np.clip(linear[..., 3:], 0, 1)
    straight = linear[..., :3] / np.maximum(alpha, 1e-6)
    return as_bytes(np.concatenate([srgb_from_linear(np.clip(straight, 0, 1)), alpha], axis=-1))


def visible_surfaces(studio: Studio, pose: Array) -> tuple[Array, Array]:
    """Surfaces visible to one camera, from rays through a regular grid in every pixel.

    Returns:
        Unit world normal averaged over the covered part of the pixel, and coverage, [S, S, 4]; and the share [S, S] of
        the pixel that shows a reflective object.
    """
    fine = studio.size * SUBPIXELS
    half = math.tan(CAMERA_ANGLE_X_RAD / 2)
    line = half * (2 * (np.arange(fine) + 0.5) / fine - 1)
    x, y = np.meshgrid(line, -line)
    in_camera = np.stack([x.ravel(), y.ravel(), -np.ones(fine * fine)])
    in_world = pose[:3, :3] @ in_camera / np.linalg.norm(in_camera, axis=0)
    mitsuba = studio.mitsuba
    rays = mitsuba.Ray3f(mitsuba.Point3f(pose[:3, 3]), mitsuba.Vector3f(in_world.astype(np.float32)))
    hits = studio.scene.ray_intersect(rays)
    seen = np.array(hits.is_valid(), dtype=np.float64)
    normals = np.array(hits.sh_frame.n, dtype=np.float64).T * seen[:, None]
    sums = pixel_means(np.column_stack([normals, seen, studio.shows_mirror(hits) * seen]), studio.size)
    lengths = np.linalg.norm(sums[..., :3], axis=-1, keepdims=True)
    return np.concatenate([sums[..., :3] / np.maximum(lengths, 1e-9), sums[..., 3:4]], axis=-1), sums[..., 4]


def pixel_means(values: Array, size: int) -> Array:
    """Means [size, size, D] over the subpixels of every pixel, from rows of subpixels [size^2 SUBPIXELS^2, D]."""
    return values.reshape(size, SUBPIXELS, size, SUBPIXELS, -1).mean(axis=(1, 3))


def srgb_from_linear(linear: Array) -> Array:
    """sRGB values in [0, 1] of linear radiance in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def as_bytes(unit: Array) -> NDArray[np.uint8]:
    """Values in [0, 1] as uint8."""
    return np.round(np.clip(unit, 0, 1) * 255).astype(np.uint8)


def write_truth(studio: Studio, pose: Array, stem: Path) -> None:
    """Writes `<stem>_normal.png` and `<stem>_strength.png` of one view."""
    normals, strength = visible_surfaces(studio, pose)
    encoded = np.concatenate([(normals[..., :3] + 1) / 2, normals[..., 3:]], axis=-1)
    encoded[normals[..., 3] == 0] = 0
    Image.fromarray(as_bytes(encoded)).save(f"{stem}_normal.png", optimize=True)
    Image.fromarray(as_bytes(strength)).save(f"{stem}_strength.png", optimize=True)


def write_estimate(studio: Studio, pose: Array, stem: Path, error_deg: float, seed: int) -> None:
    """Writes `normals/<name>.png` next to a photograph, in the camera's axes: x right, y up, z towards the camera."""
    seen, _ = visible_surfaces(studio, pose)
    in_camera = seen[..., :3] @ pose[:3, :3]
    normals = estimated_normals(in_camera, seen[..., 3], error_deg, np.random.default_rng(seed))
    encoded = np.concatenate([(normals + 1) / 2, normals.any(axis=-1, keepdims=True)], axis=-1)
    folder = stem.parent / NORMALS_FOLDER
    folder.mkdir(exist_ok=True)
    Image.fromarray(as_bytes(encoded)).save(folder / f"{stem.name}.png", optimize=True)


def write_views(studio: Studio, folder: Path, part: Literal["train", "test"], arguments: Arguments) -> None:
    """Renders one part of the split, and writes its `transforms_<part>.json` when it is complete."""
    count, azimuth_rad = (arguments.train, 0.0) if part == "train" else (arguments.test, TEST_AZIMUTH_RAD)
    (folder / part).mkdir()
    frames = []
    started = time.monotonic()
    for number, position in enumerate(camera_positions(count, azimuth_rad)):
        pose = world_from_opengl(position)
        stem = folder / part / f"r_{number}"
        seed = number if part == "train" else arguments.train + number
        pixels = photograph(studio, pose, arguments.samples, seed)
        Image.fromarray(pixels).save(f"{stem}.png", optimize=True)
        if part == "test":
            write_truth(studio, pose, stem)
        elif arguments.estimated_normals is not None:
            write_estimate(studio, pose, stem, arguments.estimated_normals, seed)
        frames.append({"file_path": f"./{part}/r_{number}", "transform_matrix": pose.tolist()})
        print(f"\r{folder.name} {part} {number + 1}/{count}, {time.monotonic() - started:.0f} s", end="", flush=True)
    print()
    settings = {"camera_angle_x": CAMERA_ANGLE_X_RAD, "frames": frames}
    (folder / f"transforms_{part}.json").write_text(json.dumps(settings, indent=1) + "\n")


def write_environment(mitsuba: Any, environment: Array, folder: Path) -> None:
    """Writes `environment.exr`, linear radiance in half floats, and `environment.png`, sRGB clipped at 1."""
    bitmap = mitsuba.Bitmap(np.ascontiguousarray(environment, dtype=np.float32))
    bitmap.convert(component_format=mitsuba.Struct.Type.Float16).write(str(folder / "environment.exr"))
    Image.fromarray(as_bytes(srgb_from_linear(np.clip(environment, 0, 1)))).save(
        folder / "environment.png", optimize=True
    )


def write_points(count: int, folder: Path) -> None:
    """Writes `points3d.ply`: random points in the bounding box of NeRF-synthetic captures."""
    cloud = points_in_box(count)
    rows = np.concatenate([cloud.positions, cloud.colors], axis=1).astype(np.float32)
    write_table(folder / "points3d.ply", ["x", "y", "z", "red", "green", "blue"], rows)


def main(arguments: Arguments) -> None:
    """Makes all requested scenes, after checking that none would be overwritten."""
    names = arguments.scenes or (() if arguments.seed else NAMES)
    wanted: list[SceneName | int] = [*names, *arguments.seed]
    folders = {key: arguments.output / (key if isinstance(key, str) else f"drawn-{key}") for key in wanted}
    existing = [str(folder) for folder in folders.values() if folder.exists()]
    if existing:
        raise FileExistsError(f"{', '.join(existing)} exist; expected new folders, so remove them first")
    # Imported here, because the backend has to be chosen before the rest of Mitsuba can be used.
    try:
        import mitsuba
    except ImportError as error:
        raise SystemExit(f"Mitsuba 3 cannot be imported ({error}); install it: pip install -e '.[scenes]'") from error

    mitsuba.set_variant(arguments.variant)
    for key, folder in folders.items():
        make_scene(mitsuba, key, folder, arguments)


def make_scene(mitsuba: Any, key: SceneName | int, folder: Path, arguments: Arguments) -> None:
    """Makes the scene of a name or seed in a new folder."""
    folder.mkdir(parents=True)
    if isinstance(key, int) or key in NEAR_SCENES:
        drawn = draw_scene(key) if isinstance(key, int) else near_scene(cast(NearScene, key))
        environment = make_environment(arguments.environment_height, drawn.surroundings)
        studio = make_drawn_studio(mitsuba, drawn, environment, arguments.size)
        print(f"{folder.name}: " + ", ".join(f"{body.coating} {body.shape}" for body in drawn.bodies))
    else:
        environment = make_environment(arguments.environment_height)
        studio = make_studio(mitsuba, cast(StudioName, key), environment, arguments.size)
    write_environment(mitsuba, environment, folder)
    if arguments.points:
        write_points(arguments.points, folder)
    write_views(studio, folder, "test", arguments)
    write_views(studio, folder, "train", arguments)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
