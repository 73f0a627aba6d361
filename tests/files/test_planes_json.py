import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.files.sidecars import read_planes, write_planes
from glassplat.scene.panes import Planes


def random_planes(count: int = 3) -> Planes:
    generator = torch.Generator().manual_seed(5)
    return Planes(
        centers=torch.randn(count, 3, generator=generator),
        raw_normals=torch.randn(count, 3, generator=generator),
        logit_reflectances=4 * torch.randn(count, generator=generator),
        tangents=torch.randn(count, 3, generator=generator),
        half_sizes=torch.rand(count, 2, generator=generator),
        labels=tuple(range(2, 2 + count)),
        mirrors=(3,) if count > 1 else (),
    )


def edit(path: Path, **changes: object) -> None:
    entries = json.loads(path.read_text())
    for key, value in changes.items():
        if value is None:
            del entries[0][key]
        else:
            entries[0][key] = value
    path.write_text(json.dumps(entries))


def tinted_planes() -> Planes:
    logarithms = -torch.rand(3, 3, generator=torch.Generator().manual_seed(6))
    return replace(random_planes(), log_transmittances=logarithms)


@pytest.mark.parametrize("planes", [random_planes(0), random_planes(1), random_planes(3), tinted_planes()])
def test_planes_round_trip_bit_for_bit(tmp_path: Path, planes: Planes) -> None:
    write_planes(tmp_path / "planes.json", planes)
    read = read_planes(tmp_path / "planes.json")
    assert read.labels == planes.labels and read.mirrors == planes.mirrors
    assert read.tensors().keys() == planes.tensors().keys()
    for name, tensor in planes.tensors().items():
        assert torch.equal(read.tensors()[name], tensor), name


def test_a_perfect_mirror_round_trips(tmp_path: Path) -> None:
    planes = random_planes(1).with_tensors({"logit_reflectances": torch.tensor([30.0])})
    write_planes(tmp_path / "planes.json", planes)
    assert json.loads((tmp_path / "planes.json").read_text())[0]["base_reflectance"] == 1.0
    assert read_planes(tmp_path / "planes.json").logit_reflectances.item() == 30.0


def test_readable_values_are_unit_normals_and_reflectances(tmp_path: Path) -> None:
    planes = random_planes(2)
    write_planes(tmp_path / "planes.json", planes)
    entries = json.loads((tmp_path / "planes.json").read_text())
    assert [math.hypot(*entry["normal"]) for entry in entries] == pytest.approx([1.0, 1.0])
    assert [entry["base_reflectance"] for entry in entries] == planes.base_reflectances.tolist()


def test_an_edit_by_hand_wins_over_the_raw_value(tmp_path: Path) -> None:
    write_planes(tmp_path / "planes.json", random_planes())
    edit(tmp_path / "planes.json", normal=[0.0, 2.0, 0.0], base_reflectance=0.25)
    read = read_planes(tmp_path / "planes.json")
    assert read.normals[0].tolist() == [0.0, 1.0, 0.0]
    assert read.base_reflectances[0].item() == pytest.approx(0.25)
    assert torch.equal(read.raw_normals[1:], random_planes().raw_normals[1:])


def test_a_transmittance_may_be_edited_or_given_to_one_pane_alone(tmp_path: Path) -> None:
    write_planes(tmp_path / "planes.json", tinted_planes())
    edit(tmp_path / "planes.json", transmittance=[0.5, 1.0, 0.25])
    edited = read_planes(tmp_path / "planes.json").transmittances
    assert edited is not None and edited[0].tolist() == pytest.approx([0.5, 1.0, 0.25])
    torch.testing.assert_close(edited[1:], tinted_planes().log_transmittances[1:].exp())
    write_planes(tmp_path / "planes.json", random_planes())
    edit(tmp_path / "planes.json", transmittance=[0.5, 1.0, 0.25])
    given = read_planes(tmp_path / "planes.json").transmittances
    assert given is not None and given[0].tolist() == pytest.approx([0.5, 1.0, 0.25])
    assert bool((given[1:] == 1).all())


def test_raw_values_may_be_left_out(tmp_path: Path) -> None:
    write_planes(tmp_path / "planes.json", random_planes())
    edit(tmp_path / "planes.json", raw_normal=None, logit_reflectance=None, base_reflectance=1.0)
    read = read_planes(tmp_path / "planes.json")
    torch.testing.assert_close(read.normals, random_planes().normals)
    assert torch.isfinite(read.logit_reflectances).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"center": [0, 1]}, r"center of plane 1 in .*planes\.json is \[0, 1\]; expected a list of 3 values"),
        ({"center": [0, 1, 1e300]}, r"entry 3 of center of plane 1 in .* is 1e\+300; expected a finite number from"),
        ({"center": [0, 1, 10**400]}, "entry 3 of center of plane 1 in .* is inf; expected a finite number"),
        ({"center": [0, 1, math.nan]}, "entry 3 of center of plane 1 in .* is nan; expected a finite number"),
        ({"half_sizes": None}, "plane 1 in .* has no half_sizes; expected a list of 2 values"),
        ({"half_sizes": [-1, 1]}, "entry 1 of half_sizes of plane 1 in .* is -1; expected a finite number from 1e-09"),
        ({"half_sizes": [0, 0]}, "entry 1 of half_sizes of plane 1 in .* is 0; expected a finite number from 1e-09"),
        ({"half_sizes": [1, 1e300]}, r"entry 2 of half_sizes of plane 1 in .* is 1e\+300"),
        ({"normal": [0, 0, 0]}, "normal of plane 1 in .* has length 0; expected a direction"),
        ({"tangent": [0, 0, 0]}, "tangent of plane 1 in .* has length 0; expected a direction"),
        ({"normal": [0, 2, 0], "tangent": [0, -1, 0]}, "tangent of plane 1 in .* lies along its normal"),
        ({"label": "left"}, "label of plane 1 in .* is 'left'; expected a whole number from 1 to 255"),
        ({"label": 1e30}, r"label of plane 1 in .* is 1e\+30; expected a whole number from 1 to 255"),
        ({"label": True}, "label of plane 1 in .* is True; expected a whole number"),
        ({"label": 3}, "expected every label once"),
        ({"mirror": "yes"}, "mirror of plane 1 in .* is 'yes'; expected true or false"),
        ({"base_reflectance": 1.5}, "base_reflectance of plane 1 in .* is 1.5; expected a finite number from 0 to 1"),
        ({"logit_reflectance": "much"}, "logit_reflectance of plane 1 in .* is 'much'; expected a finite number"),
        ({"transmittance": [1, 1]}, r"transmittance of plane 1 in .* is \[1, 1\]; expected a list of 3 values"),
        ({"transmittance": [1, 1, 2]}, "entry 3 of transmittance of plane 1 in .* is 2; expected a finite number from"),
        ({"raw_normal": [[0], 1, 2]}, r"entry 1 of raw_normal of plane 1 in .* is \[0\]; expected a finite number"),
    ],
)
def test_a_malformed_plane_is_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    write_planes(tmp_path / "planes.json", random_planes())
    edit(tmp_path / "planes.json", **changes)
    with pytest.raises(ValueError, match=message):
        read_planes(tmp_path / "planes.json")


def test_a_cut_off_file_is_refused(tmp_path: Path) -> None:
    write_planes(tmp_path / "planes.json", random_planes())
    text = (tmp_path / "planes.json").read_text()
    (tmp_path / "planes.json").write_text(text[: len(text) // 2])
    with pytest.raises(ValueError, match="not valid JSON"):
        read_planes(tmp_path / "planes.json")


@pytest.mark.parametrize("text", ["null", "{}", "3", '"planes"'])
def test_anything_but_a_list_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "planes.json").write_text(text)
    with pytest.raises(ValueError, match=r"planes\.json holds .*; expected a list with one object per plane"):
        read_planes(tmp_path / "planes.json")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no planes file at .*planes\.json"):
        read_planes(tmp_path / "planes.json")


def test_non_finite_planes_are_not_written(tmp_path: Path) -> None:
    planes = random_planes().with_tensors({"centers": torch.full((3, 3), torch.nan)})
    with pytest.raises(ValueError, match="plane 2 cannot be written: center must be finite"):
        write_planes(tmp_path / "planes.json", planes)
    assert not list(tmp_path.iterdir())
