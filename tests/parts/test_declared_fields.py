"""Keypoints, symmetries and mirrors out of their fields."""

import pytest

from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry, SphericalSymmetry
from pnet.parts.declared_fields import keypoint_from, lookalikes_from, mirror_from, symmetry_from
from pnet.parts.primitives import Circle, Corner, Cylinder, Plane, Polygon, Sphere


@pytest.mark.parametrize(
    ("fields", "primitive"),
    [
        ({"plane": "-z", "at": "2 * h"}, Plane("-z", "2 * h")),
        ({"plane": [0, 3, 4]}, Plane((0, 3, 4))),
        ({"cylinder": "x", "towards": "z"}, Cylinder("x", "z")),
        ({"circle": [1, 1, 0], "towards": [0, 0, 1]}, Circle((1, 1, 0), (0, 0, 1))),
        ({"polygon": "y", "sides": 5}, Polygon(5, "y")),
        ({"corner": [1, "h", 2]}, Corner((1, "h", 2))),
        ({"sphere": None}, Sphere()),
    ],
)
def test_every_primitive_can_be_declared(fields, primitive):
    found = keypoint_from("kp", {"from": "centroid", "measures": "h", "factor": 2} | fields)
    assert found.primitive == primitive and type(found.primitive) is type(primitive)
    assert (found.name, found.reference, found.parameter, found.factor) == ("kp", "centroid", "h", 2.0)


@pytest.mark.parametrize(("value", "count"), [("none", 1), ({"cyclic": 4}, 4), ({"dihedral": 3}, 6)])
def test_finite_symmetries_by_name(value, count):
    found = symmetry_from(value)
    assert isinstance(found, FiniteSymmetry) and len(found.rotations) == count


def test_other_symmetries_by_name():
    assert symmetry_from("revolution") == RevolutionSymmetry(False)
    assert symmetry_from("revolution_equal_ends") == RevolutionSymmetry(True)
    assert symmetry_from("sphere") == SphericalSymmetry()
    half_turn = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]]
    found = symmetry_from({"rotations": half_turn})
    assert isinstance(found, FiniteSymmetry) and found.rotations.tolist() == half_turn
    assert mirror_from(None) is None
    assert mirror_from("-y").diag().tolist() == [1, -1, 1]


@pytest.mark.parametrize(
    "value", ["cyclic", {"cyclic": 0}, {"cyclic": 2.5}, {"cyclic": 2, "dihedral": 2}, {}, 6]
)
def test_an_unknown_symmetry_is_answered_with_the_choices(value):
    with pytest.raises(ValueError, match=r"symmetry is .*, choose none, revolution, .*\{cyclic: n\}"):
        symmetry_from(value)


def test_lookalikes_are_exchanges_of_pairs_of_names():
    found = lookalikes_from([[["a", "b"], ["c", "d"]], [["a", "c"]]])
    assert found == ((("a", "b"), ("c", "d")), (("a", "c"),))
    assert lookalikes_from([]) == ()
