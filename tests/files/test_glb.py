"""GLB: round trips are exact, another program reads the same, and files with false sizes cost nothing."""

from __future__ import annotations

import json
import struct
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from glassplat.files.glb import CHUNK, EXTENSION, HEADER, MAGIC, VERSION, read_glb, write_glb
from glassplat.kernels.project.reference import rotations, sh_basis
from glassplat.scene import SH_ZERO
from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.gaussians import Gaussians
from tests.files.test_spz import shapes, typical

FLIP = torch.tensor([-1.0, -1.0, 1.0])
FOREIGN = Path(__file__).parent.parent / "data_files" / "splat_transform.glb"
"""`typical()` in 3 Gaussians, written by splat-transform 3.7 from our PLY."""


def written(folder: Path, gaussians: Gaussians | None = None) -> Path:
    write_glb(folder / "a.glb", typical() if gaussians is None else gaussians)
    return folder / "a.glb"


def edited(path: Path, edit: Callable[[dict[str, Any]], None]) -> Path:
    """The same file with an edited document."""
    data = path.read_bytes()
    size, kind = CHUNK.unpack_from(data, HEADER.size)
    start = HEADER.size + CHUNK.size
    document = json.loads(data[start : start + size])
    edit(document)
    text = json.dumps(document).encode()
    rest = data[start + size :]
    head = HEADER.pack(b"glTF", 2, start + len(text) + len(rest)) + CHUNK.pack(len(text), kind)
    path.write_bytes(head + text + rest)
    return path


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_written_values_are_read_back(coefficients: int, tmp_path: Path) -> None:
    before = typical(coefficients)
    after = read_glb(written(tmp_path, before))
    assert after.active_sh_degree == before.max_sh_degree and not after.channels
    assert torch.equal(after.means, before.means) and torch.equal(after.sh, before.sh)
    torch.testing.assert_close(after.log_scales, before.log_scales, rtol=0, atol=1e-6)
    torch.testing.assert_close(
        torch.sigmoid(after.logit_opacities), torch.sigmoid(before.logit_opacities), rtol=0, atol=1e-6
    )
    torch.testing.assert_close(after.quats, torch.nn.functional.normalize(before.quats, dim=1))


def test_channels_round_trip_bit_for_bit(tmp_path: Path) -> None:
    values = torch.linspace(-3, 2, len(typical()))
    before = replace(typical(), channels={"log_intensity": values, "logit_strength": values.flip(0)})
    path = written(tmp_path, before)
    after = read_glb(path)
    assert set(after.channels) == set(before.channels)
    assert all(torch.equal(after.channels[name], before.channels[name]) for name in before.channels)
    attributes = pygltflib.GLTF2().load(path).meshes[0].primitives[0].attributes
    assert hasattr(attributes, "_GLASSPLAT_LOG_INTENSITY"), "other programs leave alone what begins with an underscore"


def test_standard_attributes_are_no_channels(tmp_path: Path) -> None:
    def rename(document: dict[str, Any]) -> None:
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        attributes["_GLASSPLAT_LOG_SCALES"] = attributes.pop("_GLASSPLAT_LOG_INTENSITY")
        attributes["_GLASSPLAT_MEANS"] = attributes["_GLASSPLAT_LOG_SCALES"]

    before = replace(typical(), channels={"log_intensity": torch.zeros(len(typical()))})
    after = read_glb(edited(written(tmp_path, before), rename))
    assert not after.channels and torch.equal(after.means, before.means)


def test_sets_of_which_one_has_no_channels_come_back_without(tmp_path: Path) -> None:
    def twice(document: dict[str, Any]) -> None:
        primitives = document["meshes"][0]["primitives"]
        bare = {k: v for k, v in primitives[0]["attributes"].items() if not k.startswith("_")}
        primitives.append({**primitives[0], "attributes": bare})

    before = replace(typical(), channels={"log_intensity": torch.zeros(len(typical()))})
    after = read_glb(edited(written(tmp_path, before), twice))
    assert len(after) == 2 * len(before) and not after.channels


@pytest.mark.parametrize(
    ("nodes", "meshes", "message"), [(2001, 1, "more than 2000 sets"), (10_001, 0, "more than 10000 nodes")]
)
def test_a_small_file_does_not_show_one_set_for_minutes(nodes: int, meshes: int, message: str, tmp_path: Path) -> None:
    def crowd(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0} if meshes else {}] * nodes
        document["scenes"] = [{"nodes": list(range(nodes))}]

    with pytest.raises(ValueError, match=message):
        read_glb(edited(written(tmp_path, typical()), crowd))


def test_a_channel_of_another_length_is_refused(tmp_path: Path) -> None:
    def shorten(document: dict[str, Any]) -> None:
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        document["accessors"][attributes["_GLASSPLAT_LOG_INTENSITY"]]["count"] -= 1

    before = replace(typical(), channels={"log_intensity": torch.zeros(len(typical()))})
    with pytest.raises(ValueError, match="one number"):
        read_glb(edited(written(tmp_path, before), shorten))
    with pytest.raises(ValueError, match="small letters"):
        write_glb(tmp_path / "b.glb", replace(before, channels={"log_X": before.logit_opacities}))


def test_discs_are_read_back_as_discs(tmp_path: Path) -> None:
    before = replace(typical(), log_scales=typical().log_scales[:, :2].contiguous())
    after = read_glb(written(tmp_path, before))
    assert after.are_discs
    torch.testing.assert_close(after.log_scales, before.log_scales, rtol=0, atol=1e-6)


def accessor(gltf: pygltflib.GLTF2, index: int) -> np.ndarray:
    found, blob = gltf.accessors[index], gltf.binary_blob()
    view, width = gltf.bufferViews[found.bufferView], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[found.type]
    start = (view.byteOffset or 0) + (found.byteOffset or 0)
    return np.frombuffer(blob, "<f4", found.count * width, start).reshape(-1, width)


def test_another_program_reads_what_the_extension_promises(tmp_path: Path) -> None:
    gaussians = typical()
    gltf = pygltflib.GLTF2().load_binary(str(written(tmp_path, gaussians)))
    assert gltf.extensionsUsed == [EXTENSION] and gltf.asset.version == "2.0"
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == pygltflib.POINTS and primitive.extensions[EXTENSION]["kernel"] == "ellipse"
    indices = vars(primitive.attributes)
    means = accessor(gltf, indices["POSITION"])
    np.testing.assert_array_equal(means, gaussians.means * FLIP)
    np.testing.assert_allclose(gltf.accessors[indices["POSITION"]].max, means.max(axis=0))
    rotation = torch.from_numpy(accessor(gltf, indices[f"{EXTENSION}:ROTATION"]).copy()).roll(1, dims=1)
    scales = torch.from_numpy(accessor(gltf, indices[f"{EXTENSION}:SCALE"]).copy())
    axes = rotations(rotation) * scales[:, None, :]
    flipped = torch.diag(FLIP) @ shapes(gaussians) @ torch.diag(FLIP)
    torch.testing.assert_close(axes @ axes.mT, flipped, atol=1e-5, rtol=1e-4)
    opacities = accessor(gltf, indices[f"{EXTENSION}:OPACITY"])[:, 0]
    np.testing.assert_allclose(opacities, torch.sigmoid(gaussians.logit_opacities), atol=1e-6)
    colors = accessor(gltf, indices["COLOR_0"])
    assert colors.min() >= 0 and colors.max() <= 1
    np.testing.assert_array_equal(colors[:, 3], opacities)
    names = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
    sh = torch.from_numpy(np.stack([accessor(gltf, indices[name]) for name in names], axis=1))
    directions = torch.nn.functional.normalize(torch.randn(7, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    ours, theirs = (sh_basis(rays) for rays in (directions, directions * FLIP))
    torch.testing.assert_close(
        torch.einsum("dk,nkc->ndc", theirs, sh), torch.einsum("dk,nkc->ndc", ours, gaussians.sh), atol=1e-5, rtol=1e-4
    )


def test_files_of_another_program_are_read() -> None:
    before, after = typical(count=3), read_glb(FOREIGN)
    torch.testing.assert_close(after.means, before.means)
    torch.testing.assert_close(after.sh, before.sh)
    torch.testing.assert_close(shapes(after), shapes(before), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(torch.sigmoid(after.logit_opacities), torch.sigmoid(before.logit_opacities))


def test_nodes_place_splats(tmp_path: Path) -> None:
    path, before = written(tmp_path), read_glb(written(tmp_path))
    half = 0.5**0.5
    turn = rotation_from_quat(torch.tensor([half, 0.0, half, 0.0]))

    def place(document: dict[str, Any]) -> None:
        matrix = torch.eye(4)
        matrix[:3, :3], matrix[:3, 3] = 2 * turn, torch.tensor([1.0, 2.0, 3.0])
        document["nodes"] = [
            {"mesh": 0, "rotation": [0, 0, 0, 1]},
            {"children": [0], "matrix": matrix.T.flatten().tolist()},
        ]
        document["scenes"] = [{"nodes": [1]}]

    after = read_glb(edited(path, place))
    expected = 2 * (before.means * FLIP) @ turn.T + torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(after.means, expected * FLIP, atol=1e-5, rtol=1e-5)
    whole = torch.diag(FLIP) @ (2 * turn) @ torch.diag(FLIP)
    torch.testing.assert_close(shapes(after), whole @ shapes(before) @ whole.T, atol=1e-4, rtol=1e-3)
    direction = torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.8]]), dim=1)
    colors = [
        torch.einsum("dk,nkc->ndc", sh_basis(ray), part.sh)
        for ray, part in ((direction, after), (direction @ whole / 2, before))
    ]
    torch.testing.assert_close(*colors, atol=1e-4, rtol=1e-3)


def test_nodes_that_lead_to_no_splats_may_be_placed_in_any_way(tmp_path: Path) -> None:
    def decorate(document: dict[str, Any]) -> None:
        document["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]})
        document["nodes"] += [{"camera": 0, "scale": [1, 1, -1], "children": [2]}, {"mesh": 1, "scale": [2, 1, 1]}]
        document["scenes"][0]["nodes"].append(1)

    def hang(document: dict[str, Any]) -> None:
        decorate(document)
        document["nodes"][2]["mesh"] = 0

    path, before = written(tmp_path), read_glb(written(tmp_path))
    assert torch.equal(read_glb(edited(path, decorate)).means, before.means)
    with pytest.raises(ValueError, match=r"node 2 of .* above it, skews, mirrors or stretches splats"):
        read_glb(edited(written(tmp_path), hang))


@pytest.mark.parametrize(
    ("outer", "inner", "is_supported"), [([2, 1, -1], [0.5, 1, -1], True), ([1.00006] * 2 + [1], None, False)]
)
def test_transforms_count_together(
    outer: list[float], inner: list[float] | None, is_supported: bool, tmp_path: Path
) -> None:
    def nest(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0, "scale": inner or outer}, {"children": [0], "scale": outer}]
        document["scenes"] = [{"nodes": [1]}]

    path, before = written(tmp_path), read_glb(written(tmp_path))
    if is_supported:
        torch.testing.assert_close(read_glb(edited(path, nest)).means, before.means)
    else:
        with pytest.raises(ValueError, match=r"node 0 of .*, together with the nodes above it"):
            read_glb(edited(path, nest))


def test_a_file_without_scenes_shows_its_nodes_where_their_parents_put_them(tmp_path: Path) -> None:
    def hang(document: dict[str, Any]) -> None:
        del document["scenes"], document["scene"]
        document["nodes"] = [{"mesh": 0}, {"children": [0], "translation": [10, 0, 0]}]

    path, before = written(tmp_path), read_glb(written(tmp_path))
    after = read_glb(edited(path, hang))
    torch.testing.assert_close(after.means, before.means + torch.tensor([10.0, 0, 0]) * FLIP)


def test_quantised_attributes_are_read(tmp_path: Path) -> None:
    path = written(tmp_path, typical(1))
    count = len(typical())

    def quantise(document: dict[str, Any]) -> None:
        primitive = document["meshes"][0]["primitives"][0]["attributes"]
        index = primitive[f"{EXTENSION}:OPACITY"]
        document["accessors"][index] |= {"componentType": 5121, "normalized": True}
        document["bufferViews"][document["accessors"][index]["bufferView"]]["byteStride"] = 4

    shares = torch.sigmoid(read_glb(edited(path, quantise)).logit_opacities)
    data = path.read_bytes()
    gltf = pygltflib.GLTF2().load_binary(str(path))
    index = vars(gltf.meshes[0].primitives[0].attributes)[f"{EXTENSION}:OPACITY"]
    start = gltf.bufferViews[gltf.accessors[index].bufferView].byteOffset
    expected = np.frombuffer(gltf.binary_blob(), np.uint8, 4 * count, start)[::4] / 255
    np.testing.assert_allclose(shares, expected.clip(1e-7, 1 - 1e-7), atol=1e-6)
    assert len(data) > 0


def document_without(*keys: Any) -> Callable[[dict[str, Any]], None]:
    def edit(document: dict[str, Any]) -> None:
        inner: Any = document
        for key in keys[:-1]:
            inner = inner[key]
        del inner[keys[-1]]

    return edit


def document_with(value: Any, *keys: Any) -> Callable[[dict[str, Any]], None]:
    def edit(document: dict[str, Any]) -> None:
        inner: Any = document
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value

    return edit


PRIMITIVE = ("meshes", 0, "primitives", 0)
LIES = {
    "another version": (document_with("1.0", "asset", "version"), "glTF of version 1.0"),
    "no asset": (document_without("asset"), "asset of"),
    "no splats": (document_without(*PRIMITIVE, "extensions"), "shows no splats"),
    "no scene": (document_with([], "scenes", 0, "nodes"), "shows no splats"),
    "no rotation": (document_without(*PRIMITIVE, "attributes", f"{EXTENSION}:ROTATION"), "lacks .*ROTATION"),
    "a gap": (document_without(*PRIMITIVE, "attributes", f"{EXTENSION}:SH_DEGREE_2_COEF_3"), "lacks .*DEGREE_2_COEF_3"),
    "a high degree": (document_with(0, *PRIMITIVE, "attributes", f"{EXTENSION}:SH_DEGREE_4_COEF_0"), "degrees .*'4'"),
    "triangles": (document_with(4, *PRIMITIVE, "mode"), "expected them as they are"),
    "packed": (document_with({"X_spz": {}}, *PRIMITIVE, "extensions", EXTENSION, "extensions"), "packed by"),
    "another kernel": (
        document_with("cube", *PRIMITIVE, "extensions", EXTENSION, "kernel"),
        "expected one of 'ellipse'",
    ),
    "linear": (document_with("lin_rec709_display", *PRIMITIVE, "extensions", EXTENSION, "colorSpace"), "colorSpace"),
    "too many rows": (document_with(2**31, "accessors", 0, "count"), "no scene does"),
    "a few rows more": (document_with(51, "accessors", 0, "count"), "one number"),
    "a view beyond": (document_with(10**9, "bufferViews", 0, "byteOffset"), "cut off or damaged"),
    "a view that is none": (document_with(999, "accessors", 0, "bufferView"), "entry 999 of bufferViews"),
    "sparse": (document_with({}, "accessors", 0, "sparse"), "not sparse"),
    "another type": (document_with("VEC4", "accessors", 0, "type"), "expected 3 numbers a row"),
    "another file": (document_with(1, "bufferViews", 0, "buffer"), "buffer of entry 0"),
    "a circle": (document_with([0], "nodes", 0, "children"), "expected a tree"),
    "stretched": (document_with([1, 2, 1], "nodes", 0, "scale"), "skews, mirrors or stretches"),
    "mirrored": (document_with([-1, -1, -1], "nodes", 0, "scale"), "skews, mirrors or stretches"),
    "skewed": (document_with([1, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "nodes", 0, "matrix"), "skews"),
    "no list": (document_with({}, "meshes"), "expected a list"),
    "no primitives": (document_with(7, "meshes", 0, "primitives"), "no list of primitives"),
}


@pytest.mark.parametrize(("edit", "message"), LIES.values(), ids=LIES)
def test_an_inconsistent_document_is_refused(
    edit: Callable[[dict[str, Any]], None], message: str, tmp_path: Path
) -> None:
    path = edited(written(tmp_path), edit)
    with pytest.raises(ValueError, match=message):
        read_glb(path)


@pytest.mark.parametrize(
    ("text", "rest", "message"),
    [
        (b"[]  ", b"", r"holds \[\]; expected a glTF document"),
        (None, b"", "cut off or damaged"),
        (None, CHUNK.pack(4, 7) + bytes(4), "buffer of .* has 4 bytes, which are not all there"),
    ],
    ids=["a list", "no buffer", "an unknown buffer"],
)
def test_a_file_of_other_chunks_is_refused(text: bytes | None, rest: bytes, message: str, tmp_path: Path) -> None:
    path = written(tmp_path)
    data = path.read_bytes()
    size, kind = CHUNK.unpack_from(data, HEADER.size)
    text = data[HEADER.size + CHUNK.size :][:size] if text is None else text
    body = CHUNK.pack(len(text), kind) + text + rest
    path.write_bytes(HEADER.pack(MAGIC, VERSION, HEADER.size + len(body)) + body)
    with pytest.raises(ValueError, match=message):
        read_glb(path)


def test_one_mesh_shown_over_and_over_is_refused(tmp_path: Path) -> None:
    def repeat(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0}] * 1100
        document["scenes"] = [{"nodes": list(range(1100))}]

    with pytest.raises(ValueError, match="no scene does"):
        read_glb(edited(written(tmp_path, typical(count=1000)), repeat))


def test_logarithmic_scales_of_drafts_are_reported(tmp_path: Path) -> None:
    path = written(tmp_path)
    data = bytearray(path.read_bytes())
    gltf = pygltflib.GLTF2().load_binary(str(path))
    index = vars(gltf.meshes[0].primitives[0].attributes)[f"{EXTENSION}:SCALE"]
    at = len(data) - len(gltf.binary_blob()) + gltf.bufferViews[gltf.accessors[index].bufferView].byteOffset
    struct.pack_into("<f", data, at, -3.0)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"as drafts of .* stored logarithms"):
        read_glb(path)


@pytest.mark.parametrize("cut", [0, 3, 11, 19, 25, 500, -1])
def test_a_file_that_is_cut_off_is_refused(cut: int, tmp_path: Path) -> None:
    path = written(tmp_path)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ValueError, match=r"cut off|not a GLB"):
        read_glb(path)


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = typical()
    broken.means[3, 1] = torch.nan
    for gaussians, message in ((Gaussians.empty(1), "no Gaussians"), (broken, "means are not all finite")):
        with pytest.raises(ValueError, match=message):
            write_glb(tmp_path / "a.glb", gaussians)
    monkeypatch.setattr("glassplat.files.glb.MOST_BYTES", 1000)
    with pytest.raises(ValueError, match="expected at most 1000: use PLY or SPZ"):
        write_glb(tmp_path / "a.glb", typical())
    assert not list(tmp_path.iterdir())


def test_the_colours_of_the_points_are_linear(tmp_path: Path) -> None:
    grey = typical(1, count=1)
    grey = grey.with_tensors({"sh": torch.zeros_like(grey.sh)})
    gltf = pygltflib.GLTF2().load_binary(str(written(tmp_path, grey)))
    assert SH_ZERO > 0
    color = accessor(gltf, vars(gltf.meshes[0].primitives[0].attributes)["COLOR_0"])
    np.testing.assert_allclose(color[0, :3], 0.2140, atol=1e-3)


@given(st.data())
def test_mutated_files_end_in_a_message_and_in_little_memory(tmp_path_factory: Any, data: st.DataObject) -> None:
    path = written(tmp_path_factory.mktemp("glb"), typical(4, count=5))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content))
    tracemalloc.start()
    with suppress(ValueError):
        read_glb(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24
