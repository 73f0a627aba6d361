"""A scene as a folder of files: standard PLY, and beside it glass, planes and environment."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from glassplat.files.atomic import atomic_write
from glassplat.files.environment_file import read_environment, write_environment
from glassplat.files.planes_json import read_planes, write_planes
from glassplat.files.ply import read_gaussians, write_gaussians
from glassplat.scene.scene import Scene

PRIMARY, GLASS, PLANES, SCENE = "point_cloud.ply", "glass.ply", "planes.json", "scene.json"
ENVIRONMENT = "environment.safetensors"


def write_scene(folder: Path, scene: Scene) -> None:
    """Writes a scene so that `read_scene` returns it exactly.

    `point_cloud.ply` holds the primary Gaussians, which any splat viewer shows without the reflections;
    `glass.ply` and `planes.json` hold what a viewer that knows panes needs on top, `environment.safetensors` the raw
    texels of the environment's cube map. Each is there only where the scene has it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_gaussians(folder / PRIMARY, scene.primary)
    if len(scene.planes):
        write_gaussians(folder / GLASS, scene.glass)
        write_planes(folder / PLANES, scene.planes)
    if not scene.environment.is_empty:
        write_environment(folder / ENVIRONMENT, scene.environment)
    header = {"extent": scene.extent, "active_sh_degree": scene.primary.active_sh_degree}
    with atomic_write(folder / SCENE) as temporary:
        temporary.write_text(json.dumps(header, indent=2) + "\n", encoding="utf-8")


def read_scene(folder: Path) -> Scene:
    """Reads what `write_scene` wrote.

    Raises:
        FileNotFoundError, ValueError: a file is missing, truncated or foreign.
    """
    header = json.loads((folder / SCENE).read_text(encoding="utf-8"))
    primary = replace(read_gaussians(folder / PRIMARY), active_sh_degree=header["active_sh_degree"])
    scene = Scene(primary, header["extent"])
    if (folder / PLANES).is_file():
        scene = replace(scene, glass=read_gaussians(folder / GLASS), planes=read_planes(folder / PLANES))
    if (folder / ENVIRONMENT).is_file():
        scene = replace(scene, environment=read_environment(folder / ENVIRONMENT))
    return scene
