"""Parts out of a config: the same as one in Python, and what is wrong said with its key."""

import copy

import numpy as np
import pytest
import torch

from pnet.parts.declared import DeclaredPart
from pnet.parts.tn06 import TN06
from pnet.parts.tn42 import TN42

NUT = {
    "name": "nut",
    "parameters": ["r", "h", "d"],
    "solid": [
        {"add": "polygon", "sides": 6, "circumradius": "d", "low": "-h / 2", "high": "h / 2"},
        {"hole": "cylinder", "radius": "r", "low": "-h / 2", "high": "h / 2"},
    ],
    "symmetry": {"dihedral": 6},
    "keypoints": {
        "face": {"from": "centroid", "plane": "z", "measures": "h", "factor": 0.5},
        "hole": {"from": "face", "circle": "z", "measures": "r"},
        "vertex": {"from": "face", "polygon": "z", "sides": 6, "measures": "d"},
    },
    "require": ["r < d * sqrt(3) / 2"],
    "learning": {"r": [2.5, 7], "h": [8, 11], "d": [12, 18]},
}
BAR = {
    "name": "bar",
    "parameters": ["l", "a", "w"],
    "solid": [
        {
            "add": "extrusion",
            "outline": [[0, 0], ["a", 0], [6, "l"], [0, "l"]],
            "low": "-w / 2",
            "high": "w / 2",
            "axis": "y",
        }
    ],
    "mirror": "y",
    "keypoints": {
        "foot": {"from": "centroid", "corner": [0, 0, 0]},
        "toe": {"from": "foot", "plane": "x", "measures": "l"},
        "head": {"from": "foot", "plane": "z", "measures": "a"},
        "tip": {"from": "toe", "plane": "z", "at": 6},
        "side": {"from": "centroid", "plane": "y", "measures": "w", "factor": 0.5},
    },
    "lookalikes": [
        [["foot", "toe"], ["head", "tip"]],
        [["foot", "head"], ["toe", "tip"]],
        [["foot", "tip"], ["toe", "head"]],
    ],
    "learning": {"l": [30, 40], "a": [10, 16], "w": [8, 10]},
}


def made(declaration: dict, **changes) -> DeclaredPart:
    return DeclaredPart(**copy.deepcopy(declaration | changes))


@pytest.mark.parametrize(("declaration", "twin"), [(NUT, TN06), (BAR, TN42)], ids=["nut", "bar"])
def test_a_declared_part_is_its_twin_in_python(declaration, twin):
    part, other = made(declaration), twin(declaration["learning"])
    grid = torch.from_numpy(other.grids["L"])
    np.testing.assert_array_equal(part.grids["L"], other.grids["L"])
    torch.testing.assert_close(
        part.chain.keypoints_from_parameters(grid),
        other.chain.keypoints_from_parameters(grid),
        atol=1e-12,
        rtol=0,
    )
    torch.testing.assert_close(part.chain.group, other.chain.group)
    assert part.chain.names == other.chain.names
    assert part.chain.lookalikes.tolist() == other.chain.lookalikes.tolist()
    for row in other.grids["L"]:
        np.testing.assert_allclose(part.centroid(row[None]), other.centroid(row[None]), atol=1e-12)
        mesh, expected = part.mesh(row), other.mesh(row)
        assert mesh.volume == pytest.approx(expected.volume, rel=1e-9)
        np.testing.assert_allclose(mesh.bounds, expected.bounds, atol=1e-9)
        assert len(part.convex_pieces(row, True)) == len(other.convex_pieces(row, True)) == 1


@pytest.mark.parametrize(
    ("step", "volume"),
    [
        ({"add": "cylinder", "radius": 2, "low": 0, "high": "a"}, 12 * 4 * np.sin(np.pi / 12) * 10),
        ({"add": "box", "x": [0, 2], "y": ["-a", "a"], "z": [1, 4]}, 120),
        ({"add": "polygon", "sides": 4, "circumradius": "a", "low": 0, "high": 1}, 200),
        (
            {"add": "cone", "low_radius": "a", "high_radius": 0, "low": 0, "high": 3},
            1200 * np.sin(np.pi / 12),
        ),
        ({"add": "revolution", "profile": [[0, 0], ["a", 0], [0, 3]]}, 1200 * np.sin(np.pi / 12)),
        ({"add": "extrusion", "outline": [[0, 0], ["a", 0], [0, "a / 2"]], "low": 0, "high": 2}, 50),
    ],
)
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_every_shape_can_be_declared_and_placed(step, volume, axis):
    placed = step | {"axis": axis, "at": [1, "a", -2]}
    keypoints = {
        "corner": {"from": "centroid", "corner": [30, 20, 10]},
        "end": {"from": "centroid", "plane": [1, 2, 2], "measures": "a"},
    }
    part = DeclaredPart("one", ["a"], [placed], keypoints, {"a": [10]}, sections=24)
    mesh = part.mesh(np.array([0.010]))
    assert 1e9 * mesh.volume == pytest.approx(volume, rel=1e-9)
    own = DeclaredPart("one", ["a"], [step], keypoints, {"a": [10]}, sections=24)
    turned = np.roll(own.centroid(np.array([[0.010]]))[0], "zxy".index(axis))
    np.testing.assert_allclose(
        part.centroid(np.array([[0.010]]))[0], turned + np.array([0.001, 0.010, -0.002]), atol=1e-12
    )


def test_a_sphere_can_be_declared():
    skin = {"skin": {"from": "centroid", "sphere": None, "measures": "r"}}
    part = DeclaredPart(
        "ball", ["r"], [{"add": "sphere", "radius": "r"}], skin, {"r": [5]}, symmetry="sphere"
    )
    assert 1e9 * part.mesh(np.array([0.005])).volume == pytest.approx(4 / 3 * np.pi * 125, rel=0.01)


BAD_STEPS = [
    (
        {"add": "cylindre", "radius": 1},
        r"solid\[0\]: no shape 'cylindre', did you mean cylinder\?; there are",
    ),
    ({"radius": 1, "low": 0, "high": 1}, r"solid\[0\] is .*, expected exactly one of add, cut, hole"),
    ({"add": "cylinder", "cut": "box"}, r"solid\[0\] is .*, expected exactly one of add, cut, hole"),
    ({"cut": "cylinder", "radius": 1, "low": 0, "high": 1}, r"solid\[0\]: the first step must add something"),
    (
        {"add": "cylinder", "radius": 1},
        r"solid\[0\]: a cylinder takes radius, low, high \(and axis, at\), got radius",
    ),
    ({"add": "sphere", "radius": 1, "r": 1}, r"solid\[0\]: a sphere takes radius .* got r, radius"),
    ({"add": "sphere", "radius": 1, "axis": "w"}, r"solid\[0\]: axis is 'w', choose x, y or z"),
    ({"add": ["sphere"], "radius": 1}, r"solid\[0\]: no shape \['sphere'\]"),
    ({"add": "sphere", "radius": "q"}, r"'q' is not one of the parameters"),
    ({"add": "sphere", "radius": "r.real"}, r"'r.real': a length is made of numbers, parameters"),
    ({"add": "sphere", "radius": "r", "at": [0, "q", 0]}, r"'q' is not one of the parameters"),
]


@pytest.mark.parametrize(("step", "message"), BAD_STEPS)
def test_a_bad_step_is_named(step, message):
    with pytest.raises(ValueError, match=rf"nut: .*{message}"):
        made(NUT, solid=[step])


BAD_KEYPOINTS = [
    (3, "is 3, expected exactly one of plane, "),
    ({"from": "centroid", "plan": "z"}, ".*expected exactly one of plane, .*, did you mean plane"),
    ({"from": "centroid", "measures": "h"}, "is .*, expected exactly one of plane, "),
    ({"from": "centroid", "plane": "z", "circle": "z"}, "is .*, expected exactly one of "),
    ({"plane": "z", "measures": "h"}, "say with from: where its distance starts"),
    ({"from": "centroid", "plane": "w", "measures": "h"}, "direction 'w': choose x, y, z"),
    (
        {"from": "centroid", "polygon": "z", "measures": "d"},
        "sides is None, expected a whole number of at least 3",
    ),
    (
        {"from": "centroid", "circle": "z", "towards": "z", "measures": "r"},
        "towards z is not perpendicular to the axis z",
    ),
    (
        {"from": "centroid", "circle": [1, 1, 0], "measures": "r"},
        r"about the axis \(1.0, 1.0, 0.0\): say with towards=",
    ),
]


@pytest.mark.parametrize(("fields", "message"), BAD_KEYPOINTS)
def test_a_bad_keypoint_is_named(fields, message):
    with pytest.raises(ValueError, match=rf"nut: keypoints.culprit.*{message}"):
        made(NUT, keypoints=NUT["keypoints"] | {"culprit": fields})


BAD_LOOKALIKES = [
    ("foot", r"lookalikes is 'foot', expected a list of exchanges, each a list of pairs of keypoints"),
    ({"foot": "toe"}, r"lookalikes is \{'foot': 'toe'\}, expected a list of exchanges"),
    ([["foot", "toe"]], r"lookalikes\[0\]\[0\] is 'foot', expected a pair of keypoints such as"),
    ([BAR["lookalikes"][0], 7], r"lookalikes\[1\] is 7, expected a list of pairs of keypoints such as"),
    ([[["foot", "toe", "tip"]]], r"lookalikes\[0\]\[0\] is .*'tip'\], expected the names of two keypoints"),
    ([[["foot", 3]]], r"lookalikes\[0\]\[0\] is \['foot', 3\], expected the names of two keypoints"),
    ([[["foot", "paw"]]], "lookalikes exchange 'paw', which is none of the keypoints .*: foot, side, toe, "),
    ([[["paw", "foot"]]], "lookalikes exchange 'paw', which is none of the keypoints"),
    ([[["foot", "toe"], ["toe", "tip"]]], "lookalikes: .* exchanges a keypoint twice; name it in one pair"),
    ([[["head", "tip"]]], "lookalikes: every exchange must bring another keypoint to the place of 'foot'"),
    ([[]], "lookalikes: every exchange must bring another keypoint to the place of 'foot'"),
]


@pytest.mark.parametrize(("lookalikes", "message"), BAD_LOOKALIKES)
def test_bad_lookalikes_are_named(lookalikes, message):
    with pytest.raises(ValueError, match=rf"bar: {message}"):
        made(BAR, lookalikes=lookalikes)


def test_lookalikes_may_be_left_out():
    part = made({key: value for key, value in BAR.items() if key != "lookalikes"})
    assert part.lookalikes == () and part.chain.lookalikes.tolist() == [[0, 1, 2, 3, 4]]


def test_a_requirement_that_does_not_hold_is_quoted():
    with pytest.raises(ValueError, match=r"nut: r < d \* sqrt\(3\) / 2 does not hold for r = 11 mm"):
        made(NUT, learning={"r": [11], "h": [8], "d": [12]})


def test_other_faults_carry_the_parts_name():
    with pytest.raises(ValueError, match="nut: the solid has no step"):
        made(NUT, solid=[])
    with pytest.raises(ValueError, match="nut: no keypoint determines the parameter 'q'"):
        made(NUT, parameters=["r", "h", "d", "q"], learning=NUT["learning"] | {"q": [1]})
    with pytest.raises(ValueError, match="nut: symmetry is 'hexagonal'"):
        made(NUT, symmetry="hexagonal")
    with pytest.raises(ValueError, match="nut: direction 'w'"):
        made(NUT, mirror="w")
    with pytest.raises(ValueError, match=r"'r \+ h' compares nothing"):
        made(NUT, require=["r + h"])
