"""Where the second keypoint lies on each primitive, and how free it is."""

import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.parts.primitives import Circle, Corner, Cylinder, Freedom, Plane, Polygon, Sphere, unit


@pytest.mark.parametrize(
    ("primitive", "direction", "freedom", "axis"),
    [
        (Plane("-y"), (0, -1, 0), Freedom.NONE, (0, -1, 0)),
        (Plane((0, 3, 4)), (0, 0.6, 0.8), Freedom.NONE, (0, 0.6, 0.8)),
        (Sphere(), (0, 0, 1), Freedom.SPHERE, (0, 0, 1)),
        (Cylinder(), (1, 0, 0), Freedom.TURN, (0, 0, 1)),
        (Cylinder("x"), (0, 1, 0), Freedom.TURN, (1, 0, 0)),
        (Circle("-y"), (0, 0, 1), Freedom.TURN, (0, -1, 0)),
        (Circle("z", towards="-y"), (0, -1, 0), Freedom.TURN, (0, 0, 1)),
        (Polygon(6), (1, 0, 0), Freedom.NONE, (0, 0, 1)),
        (Polygon(3, "x", (0, 1, 1)), (0, math.sqrt(0.5), math.sqrt(0.5)), Freedom.NONE, (1, 0, 0)),
        (Corner((1, "r", 2)), (0, 0, 0), Freedom.NONE, (0, 0, 0)),
    ],
)
def test_each_primitive_says_where_its_keypoint_lies(primitive, direction, freedom, axis):
    assert primitive.direction.tolist() == pytest.approx(direction)
    assert primitive.freedom is freedom
    assert primitive.axis.tolist() == pytest.approx(axis)


@settings(max_examples=30, deadline=None)
@given(st.tuples(*[st.floats(-100, 100)] * 3).filter(lambda v: math.hypot(*v) > 1e-3))
def test_three_numbers_are_a_direction_of_any_length(vector):
    found = unit(vector)
    assert found.tolist() == pytest.approx([x / math.hypot(*vector) for x in vector], abs=1e-12)


@pytest.mark.parametrize("name", ["w", "--z", "", "zz", "+x"])
def test_an_unknown_axis_is_named(name):
    with pytest.raises(ValueError, match=re.escape(f"direction {name!r}: choose x, y, z, -x, -y, -z or")):
        unit(name)


NO_DIRECTIONS = [(0.0, 0.0, 0.0), (1.0, 0.0), (math.nan, 0.0, 1.0), (math.inf, 0.0, 0.0)]


@pytest.mark.parametrize("vector", NO_DIRECTIONS)
def test_numbers_that_are_no_direction_are_refused(vector):
    with pytest.raises(ValueError, match="expected three finite numbers, not all zero"):
        unit(vector)


@pytest.mark.parametrize("make", [Cylinder, Circle, lambda around, towards=None: Polygon(4, around, towards)])
def test_an_oblique_axis_needs_to_be_told_where_its_keypoint_lies(make):
    with pytest.raises(ValueError, match=r"about the axis \(1, 1, 0\): say with towards="):
        _ = make((1, 1, 0)).direction
    assert make((1, 1, 0), "z").direction.tolist() == [0, 0, 1]


@pytest.mark.parametrize("towards", ["x", "-x", (1.0, 1.0, 0.0)])
def test_a_keypoint_that_is_not_across_the_axis_is_refused(towards):
    with pytest.raises(ValueError, match="is not perpendicular to the axis x"):
        _ = Cylinder("x", towards).direction


@pytest.mark.parametrize("sides", [-1, 0, 2])
def test_a_polygon_has_at_least_three_sides(sides):
    with pytest.raises(ValueError, match=f"a polygon of {sides} sides: expected at least 3"):
        Polygon(sides)
