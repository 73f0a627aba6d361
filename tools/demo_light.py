"""Lighting of the demo scene, path-traced once with Mitsuba 3, and radiance along rays; requires Mitsuba."""

from __future__ import annotations

import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numba import njit

from tools.demo_paint import pictures, sky
from tools.demo_things import BOTTOM, LEFT, REFRACTION, RIGHT, STREET_LAMP, TOP, Array, Shape, all_shapes
from tools.pane_tracer import Seen, reflectance

mi.set_variant("llvm_ad_rgb")

SUN, TOWARDS_SUN = (3.7, 2.8, 1.76), (0.42, 0.72, 0.56)
"""Irradiance of the evening sun, and its direction: behind the shop, so that it lights the houses on the other side."""
SKY = 2.0
"""Scale factor of the sky radiance."""
BOUNCES, BRIGHTEST = 6, 40.0
"""Maximum length of a light path, and clamp of its radiance against fireflies."""
AT_ONCE = 1_500_000
"""Number of paths traced at a time."""
ABOVE, MET_BEFORE = 2e-3, 1e-2
"""Height above a vertex at which its paths start, and the distance within which they have to hit it, metres."""
SMOOTHINGS = 8
"""Number of smoothing steps of the vertex lighting against noise."""


class LitScene:
    """The scene without the pane, with the incident light stored at every vertex."""

    def __init__(self, paths: int, exposure: float, cache: Path | None = None) -> None:
        """Path-traces the light, or loads it from the file `cache` if it exists."""
        self._exposure = exposure
        shapes = _merged(all_shapes())
        self._scene = _loaded(shapes)
        if cache is not None and cache.exists():
            lights = list(np.load(cache).values())
        else:
            lights = _light_at(self._scene, shapes, paths)
            if cache is not None:
                np.savez(cache, *lights)
        meshes = {mesh.id(): mesh for mesh in self._scene.shapes()}
        for number, (shape, light) in enumerate(zip(shapes, lights, strict=True)):
            glow = np.broadcast_to(shape.glow or (0, 0, 0), light.shape)
            for name, values in (("vertex_light", light), ("vertex_glow", glow)):
                meshes[f"m{number}"].add_attribute(name, 3, np.ascontiguousarray(values, np.float32).ravel())
        self._sky = self._scene.environment()

    def radiance(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Linear radiance [N, 3] along rays with unit directions, ignoring the pane, and distances [N]."""
        hit = self._scene.ray_intersect(mi.Ray3f(_points(origins), mi.Vector3f(_points(directions))))
        met = hit.is_valid()
        albedo = hit.bsdf().eval_diffuse_reflectance(hit, met)
        light, glow = (hit.shape.eval_attribute_3(name, hit, met) for name in ("vertex_light", "vertex_glow"))
        value = dr.select(met, albedo * mi.Color3f(light) + mi.Color3f(glow), self._sky.eval(hit, ~met))
        colors = np.array(value).T.reshape(-1, 3).astype(float)
        return self._exposure * colors, np.where(np.array(met), np.array(hit.t), np.inf)

    def seen(self, origins: Array, directions: Array) -> Seen:
        """Traces rays [N, 3] with unit directions that start in front of the pane."""
        transmission, distance = self.radiance(origins, directions)
        inwards = directions[:, 1]
        to_pane = np.where(inwards > 0, -origins[:, 1] / np.maximum(inwards, 1e-9), np.inf)
        place = origins + np.where(np.isfinite(to_pane), to_pane, 0)[:, None] * directions
        x, z = place[:, 0], place[:, 2]
        met = (to_pane < distance) & (x > LEFT) & (x < RIGHT) & (z > BOTTOM) & (z < TOP)
        strength = np.where(met, _strengths(np.abs(inwards)), 0.0)
        reflection = np.zeros_like(transmission)
        if met.any():
            reflection[met] = self.radiance(place[met] - [0, 1e-4, 0], directions[met] * [1, -1, 1])[0]
        radiance = (1 - strength)[:, None] * transmission + strength[:, None] * reflection
        to_pane = np.where(met, to_pane, np.inf)
        label, no_silver = met.astype(np.uint8), np.zeros_like(radiance)
        return Seen(radiance, transmission, reflection, strength, label, no_silver, distance, to_pane)


@njit(cache=True)
def _strengths(cosines: Array) -> Array:
    """Reflectance of the pane, by the cosines [N] between rays and its normal."""
    strengths = np.empty_like(cosines)
    for number in range(len(cosines)):
        strengths[number] = reflectance(cosines[number], REFRACTION)
    return strengths


def _merged(shapes: list[Shape]) -> list[Shape]:
    """Merges shapes with the same texture and glow."""
    groups = defaultdict(list)
    for shape in shapes:
        groups[shape.paint, shape.glow].append(shape)
    whole = []
    for (name, glow), parts in groups.items():
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        columns = [np.concatenate([getattr(part, field) for part in parts]) for field in ("vertices", "normals", "uv")]
        faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
        whole.append(Shape(*columns, faces, name, glow))
    return whole


def _loaded(shapes: list[Shape]) -> Any:
    """The scene as a Mitsuba scene."""
    materials = {}
    for name, picture in pictures().items():
        bitmap = mi.Bitmap((255 * np.ascontiguousarray(picture[::-1])).astype(np.uint8))
        texture = {"type": "bitmap", "bitmap": bitmap, "wrap_mode": "repeat"}
        materials[name] = mi.load_dict({"type": "diffuse", "reflectance": texture})
    described: dict[str, Any] = {
        "type": "scene",
        "sky": {
            "type": "envmap",
            "bitmap": mi.Bitmap(sky().astype(np.float32)),
            "scale": SKY,
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        },
        "sun": {
            "type": "directional",
            "direction": [-part for part in TOWARDS_SUN],
            "irradiance": {"type": "rgb", "value": SUN},
        },
    }
    for number, shape in enumerate(shapes):
        properties = mi.Properties()
        properties["bsdf"] = materials[shape.paint]
        if shape.glow and shape.glow != STREET_LAMP:  # Street lamps emit by day, but light nothing.
            light = {"type": "area", "radiance": {"type": "rgb", "value": shape.glow}}
            properties["emitter"] = mi.load_dict(light)
        mesh = mi.Mesh(f"m{number}", len(shape.vertices), len(shape.faces), properties, True, True)
        values = mi.traverse(mesh)
        values["vertex_positions"] = shape.vertices.astype(np.float32).ravel()
        values["vertex_normals"] = shape.normals.astype(np.float32).ravel()
        values["vertex_texcoords"] = shape.uv.astype(np.float32).ravel()
        values["faces"] = shape.faces.astype(np.uint32).ravel()
        values.update()
        described[f"m{number}"] = mesh
    return mi.load_dict(described)


def _points(values: Array) -> Any:
    """Converts [N, 3] to Mitsuba points."""
    return mi.Point3f(*(mi.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in values.T))


def _light_at(scene: Any, shapes: list[Shape], paths: int) -> list[Array]:
    """Light [V, 3] at the vertices of each shape, as the radiance of a white surface there.

    A ray from just above a vertex down to it returns the radiance of the textured surface. Divided by the texture, this
    is the direct and indirect light of sun, sky and lamps.
    """
    corners = np.concatenate([_nudged(shape) for shape in shapes])
    normals = np.concatenate([shape.normals for shape in shapes])
    integrator = mi.load_dict({"type": "path", "max_depth": BOUNCES, "rr_depth": 2 * BOUNCES})
    light, begun, at_once = np.zeros((len(corners), 3)), time.monotonic(), max(1, AT_ONCE // len(corners))
    rounds = max(1, round(paths / at_once))
    origin = _points(np.repeat(corners + ABOVE * normals, at_once, axis=0))
    ray = mi.RayDifferential3f(mi.Ray3f(origin, mi.Vector3f(_points(np.repeat(-normals, at_once, axis=0)))))
    hit = scene.ray_intersect(mi.Ray3f(ray))
    albedo = hit.bsdf().eval_diffuse_reflectance(hit, hit.is_valid())
    factor = dr.select(hit.is_valid() & (hit.t < MET_BEFORE), 1 / dr.maximum(albedo, 0.004), 0.0)
    dr.eval(ray, factor)
    for number in range(rounds):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, number), dr.width(origin))  # Opaque, or every round is compiled again.
        radiance, _, _ = integrator.sample(scene, sampler, ray)
        brought = np.array(dr.clip(radiance * factor, 0.0, BRIGHTEST)).T.reshape(-1, at_once, 3)
        light += brought.mean(axis=1) / rounds
        left = (time.monotonic() - begun) / (number + 1) * (rounds - number - 1)
        print(f"\rlight {number + 1}/{rounds}, {left:.0f} s left ", end="", flush=True)
    print()
    parts = np.split(light, np.cumsum([len(shape.vertices) for shape in shapes])[:-1])
    return [_smoothed(part, shape) for part, shape in zip(parts, shapes, strict=True)]


def _nudged(shape: Shape) -> Array:
    """Vertices [V, 3] moved slightly into one of their triangles, because rays may slip between adjacent triangles."""
    towards = shape.vertices.copy()
    for corner in range(3):
        towards[shape.faces[:, corner]] = shape.vertices[shape.faces].mean(axis=1)
    return shape.vertices + 0.15 * (towards - shape.vertices)


def _smoothed(light: Array, shape: Shape) -> Array:
    """Light smoothed along the edges of triangles."""
    edges = np.concatenate([shape.faces[:, [0, 1]], shape.faces[:, [1, 2]], shape.faces[:, [2, 0]]])
    for _ in range(SMOOTHINGS):
        total, count = 2 * light, np.full(len(light), 2.0)
        for a, b in (edges.T, edges.T[::-1]):
            np.add.at(total, a, 0.25 * light[b])
            np.add.at(count, a, 0.25)
        light = total / count[:, None]
    return light
