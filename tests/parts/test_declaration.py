"""A wrong declaration is refused with the culprit's name."""

import math

import pytest
import torch

from pnet.geometry.symmetry import (
    RevolutionSymmetry,
    SphericalSymmetry,
    cyclic,
    dihedral,
    reflection,
)
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Circle, Corner, Cylinder, Plane, Polygon, Sphere
from pnet.parts.selection import Keypoint, select_keypoints

FACE = Keypoint("face", "centroid", Plane("z"), "h", 0.5)
SIDE = Keypoint("side", "centroid", Plane("x"), "w")
RIM = Keypoint("rim", "face", Circle("z"), "r")
REVOLUTION = RevolutionSymmetry()


def refused(message: str):
    return pytest.raises(ValueError, match=message)


def test_an_unknown_reference_is_named():
    with refused(r"'rim' refers to 'faec', which is not one of \['centroid', 'face'\]"):
        select_keypoints([FACE, Keypoint("rim", "faec", Circle(), "r")], ["r", "h"])


@pytest.mark.parametrize("references", ["ba", "cab", "a"])
def test_keypoints_that_hang_on_each_other_are_refused(references):
    ring = [Keypoint(name, other, Plane("z"), "h") for name, other in zip("abc", references, strict=False)]
    with refused(f"'a' refers to '{references[0]}', which is not one of \\['centroid', 'face'\\]"):
        select_keypoints([*ring, FACE], ["h"])


def test_an_unknown_parameter_is_named():
    with refused(r"'rim' measures 'q', which is not one of the parameters \['r', 'h'\]"):
        select_keypoints([FACE, Keypoint("rim", "face", Circle(), "q")], ["r", "h"])


def test_a_parameter_that_nothing_measures_is_named():
    with refused("no keypoint determines the parameter 'r'; let one measure it, or drop the parameter"):
        select_keypoints([FACE], ["h", "r"])


@pytest.mark.parametrize("declared", [[FACE, FACE], [FACE, Keypoint("face", "face", Circle(), "h")]])
def test_a_name_used_twice_is_refused(declared):
    with refused("keypoint 'face': the name is taken"):
        select_keypoints(declared, ["h"])


def test_a_keypoint_cannot_be_called_centroid():
    with refused("keypoint 'centroid': the name is taken"):
        select_keypoints([Keypoint("centroid", "centroid", Plane("z"), "h")], ["h"])


@pytest.mark.parametrize("factor", [0.0, -0.5])
def test_a_factor_that_is_not_positive_is_refused(factor):
    with refused(f"keypoint 'face': factor is {factor}, expected a positive number"):
        select_keypoints([Keypoint("face", "centroid", Plane("z"), "h", factor)], ["h"])


def test_a_corner_measures_nothing():
    with refused("keypoint 'tip' is a corner, whose place is given: it cannot measure a parameter"):
        select_keypoints([Keypoint("tip", "centroid", Corner((0, 0, 1)), "h")], ["h"])


@pytest.mark.parametrize("primitive", [Plane("z"), Circle(), Polygon(4), Sphere()])
def test_a_keypoint_without_parameter_and_place_is_refused(primitive):
    with refused("keypoint 'lost' measures no parameter and has no place"):
        select_keypoints([FACE, Keypoint("lost", "centroid", primitive)], ["h"])


@pytest.mark.parametrize("primitive", [Plane("z", at="0.3 * q"), Corner((0, "q + 1", 0))])
def test_an_expression_of_a_place_that_cannot_be_evaluated_is_named(primitive):
    with refused("keypoint 'step': '.*q.*': 'q' is not one of the parameters"):
        select_keypoints([FACE, Keypoint("step", "centroid", primitive)], ["h"])


def test_a_keypoint_on_its_reference_is_refused():
    with refused("keypoint 'middle' lies on its reference 'centroid'"):
        KeypointChain([FACE, RIM, Keypoint("middle", "centroid", Plane("z", at=0))], "rh", REVOLUTION)


@pytest.mark.parametrize(
    "extra",
    [
        Keypoint("culprit", "centroid", Plane("x"), "r"),
        Keypoint("culprit", "face", Plane((0.01, 0, 1)), "r"),
        Keypoint("culprit", "face", Cylinder("x"), "r"),
        Keypoint("culprit", "centroid", Sphere(), "r"),
        Keypoint("culprit", "face", Polygon(6), "r"),
        Keypoint("culprit", "centroid", Corner((1, 0, 2))),
    ],
)
def test_a_keypoint_off_the_axis_of_a_revolution_is_named(extra):
    with refused("keypoint 'culprit': the part is a revolution about z"):
        KeypointChain([FACE, RIM, extra], "rh", REVOLUTION)


def test_a_revolution_needs_a_keypoint_on_its_axis():
    with refused("no keypoint lies on the axis: the keypoints don't determine the axis' sense"):
        KeypointChain([Keypoint("rim", "centroid", Circle(), "r")], "r", REVOLUTION)


@pytest.mark.parametrize("primitive", [Plane("z"), Circle(), Polygon(4)])
def test_a_sphere_has_keypoints_on_spheres_only(primitive):
    with refused("a sphere's keypoints must lie on spheres about its centroid"):
        KeypointChain([Keypoint("face", "centroid", primitive, "h")], "h", SphericalSymmetry())


@pytest.mark.parametrize(
    "beside",
    [
        [],
        [Keypoint("top", "face", Plane("z"), "h")],
        [Keypoint("rim", "face", Circle("z"), "h")],
        [Keypoint("below", "centroid", Plane((0, 0, -2)), "h")],
    ],
)
@pytest.mark.parametrize("symmetry", [cyclic(1), dihedral(6)], ids=["none", "D6"])
def test_keypoints_on_one_line_do_not_determine_a_pose(beside, symmetry):
    with refused("the keypoints don't determine the pose: .* lie on one line"):
        KeypointChain([FACE, *beside], "h", symmetry)


def test_one_keypoint_beside_the_line_is_enough():
    assert KeypointChain([FACE, SIDE], "hw", cyclic(1)).is_finite == [True, True]


def test_keypoints_in_a_plane_that_the_mirror_moves_are_refused():
    """face and side lie in the zx plane; a mirror across x moves them, one across y leaves them."""
    with refused("the keypoints lie in one plane with the centroid, so a part and its mirror image"):
        KeypointChain([FACE, SIDE], "hw", cyclic(1), reflection((1, 0, 0)))
    KeypointChain([FACE, SIDE], "hw", cyclic(1), reflection((0, 1, 0)))
    off = Keypoint("off", "centroid", Plane("y"), "h")
    assert len(KeypointChain([FACE, SIDE, off], "hw", cyclic(1), reflection((1, 0, 0))).chiralities) == 2


@pytest.mark.parametrize(
    "culprit",
    [
        Keypoint("culprit", "rim", Plane("x"), "h"),  # across the circle's axis
        Keypoint("culprit", "rim", Circle("z"), "h"),  # free itself
        Keypoint("culprit", "rim", Plane("z", at=7)),  # a place, no distance
        Keypoint("culprit", "rim", Corner((1, 2, 3))),
    ],
)
def test_what_hangs_on_a_free_circle_other_than_along_its_axis_is_refused(culprit):
    with refused("keypoint 'culprit' hangs on 'rim', which is free on a circle or sphere"):
        KeypointChain([FACE, SIDE, RIM, culprit], "hwr", cyclic(1))


def test_a_distance_along_the_axis_may_hang_on_a_free_circle():
    chain = KeypointChain([FACE, RIM, Keypoint("foot", "rim", Plane("-z"), "h")], "rh", REVOLUTION)
    assert chain.is_finite == [True, False, False]


def test_nothing_hangs_on_a_sphere():
    with refused("keypoint 'outer' hangs on 'skin', which is free on a circle or sphere"):
        KeypointChain(
            [Keypoint("skin", "centroid", Sphere(), "r"), Keypoint("outer", "skin", Sphere(), "r")],
            "r",
            SphericalSymmetry(),
        )


@pytest.mark.parametrize(("sides", "n", "count"), [(4, 6, 6), (6, 4, 4), (3, 6, 6)])
def test_a_polygon_with_other_sides_than_the_symmetry_makes_is_refused(sides, n, count):
    with refused(f"keypoint 'vertex': .* makes {count} equivalents .* polygon of {sides} sides"):
        KeypointChain([FACE, Keypoint("vertex", "face", Polygon(sides), "d")], "hd", dihedral(n))


def test_a_polygon_may_have_more_sides_than_the_symmetry():
    """A hexagonal face on a part with three equal sixths only: three equivalents of a vertex."""
    KeypointChain([FACE, Keypoint("vertex", "face", Polygon(6), "d")], "hd", dihedral(3))


def test_a_vertex_beside_the_symmetry_axes_is_refused():
    """Turned by 10° the half turns make another hexagon of it: twelve equivalents about the face's centre."""
    towards = (math.cos(math.radians(10)), math.sin(math.radians(10)), 0.0)
    turned = Keypoint("vertex", "face", Polygon(6, towards=towards), "d")
    with refused("makes 12 equivalents"):
        KeypointChain([FACE, turned], "hd", dihedral(6), reflection((0, 0, 1)))


def test_the_message_of_a_bad_mirror_says_what_is_expected():
    with refused("orthonormal \\(3, 3\\) matrix with determinant -1"):
        KeypointChain([FACE, SIDE], "hw", cyclic(1), torch.eye(3, dtype=torch.float64))


def test_a_circle_that_a_reflection_moves_alone_is_refused():
    """The finite keypoints lie in the mirror plane, so nothing tells the two circles' bodies apart."""
    keypoints = [
        Keypoint("end", "centroid", Plane("x"), "l", 0.5),
        Keypoint("lid", "centroid", Plane("z"), "h", 0.5),
        Keypoint("ring", "centroid", Circle((0, 1, 1), (1, 0, 0)), "r"),
    ]
    with pytest.raises(ValueError, match="keypoint 'ring': a symmetry of the part moves its circle"):
        KeypointChain(keypoints, ["l", "h", "r"], cyclic(1), reflection((0, 1, 0)))
