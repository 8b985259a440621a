"""Shapes against closed forms, their own meshes and scipy's hulls."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from pnet.parts.shapes import Ball, Extrusion, Revolution, Shape, extrude_points, lathe, polygon
from pnet.parts.solids import box, cone, cylinder, moved, prism, solid

SECTIONS = 24
L_SHAPE = np.array([[0.0, 0], [4, 0], [4, 1], [1, 1], [1, 3], [0, 3]])  # area 6
SHAPES: dict[str, Shape] = {
    "box": box((-1.0, 2.0), (0.5, 1.0), (3.0, 5.0)),
    "hexagonal prism": prism(polygon(6, 1.5) + np.array([0.3, -0.2]), -1.0, 2.0),
    "L profile": Extrusion(L_SHAPE, 0.5, 2.0),
    "cylinder": cylinder(1.5, -1.0, 2.0),
    "frustum": cone(2.0, 0.5, 1.0, 4.0),
    "cone": cone(1.0, 0.0, -1.0, 3.0),
    "cone upside down": cone(0.0, 1.0, -1.0, 3.0),
    "ball": Ball(1.2),
    "ring": Revolution(np.array([[1.0, 0], [2, 0], [2, 3], [1, 3]])),
    "groove": Revolution(np.array([[0.0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [2, 2], [2, 3], [0, 3]])),
    "wedge ring": Revolution(np.array([[1.0, 0], [2, 1], [1, 2]])),
    "spindle": Revolution(np.array([[0.0, 0], [2, 1], [0, 4]])),
    "bell": Revolution(np.array([[0.0, 2], [1, 0], [3, 0], [2, 3], [0, 3]])),
}
EULER = dict.fromkeys(SHAPES, 2) | {"ring": 0, "wedge ring": 0}
PLACES = [("z", (0.0, 0.0, 0.0)), ("x", (1.0, -2.0, 0.5)), ("y", (0.0, 3.0, -1.0)), ("z", (-1.0, 0.2, 2.0))]


@pytest.fixture(params=SHAPES)
def name(request):
    return request.param


@pytest.mark.parametrize(("axis", "at"), PLACES)
def test_volume_and_moment_are_those_of_the_mesh_wherever_the_shape_lies(name, axis, at):
    shape = moved(SHAPES[name], axis, at)
    mesh = shape.mesh(SECTIONS)
    volume, moment = shape.volume_and_moment(SECTIONS)
    assert float(volume) == pytest.approx(mesh.volume, rel=1e-9)
    np.testing.assert_allclose(moment, mesh.volume * mesh.center_mass, atol=1e-9 * mesh.volume)


def test_meshes_are_closed_and_wound_outwards(name):
    mesh = SHAPES[name].mesh(SECTIONS)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.euler_number == EULER[name]


def test_placing_keeps_volume_and_handedness(name):
    """x, y, z are turned into each other: a part's own z goes to the axis, its x to the next one."""
    for axis, order in (("x", [2, 0, 1]), ("y", [1, 2, 0]), ("z", [0, 1, 2])):
        placed = moved(SHAPES[name], axis, (0.1, 0.2, 0.3)).mesh(SECTIONS)
        own = SHAPES[name].mesh(SECTIONS)
        assert placed.volume == pytest.approx(own.volume)
        np.testing.assert_allclose(placed.vertices, own.vertices[:, order] + [0.1, 0.2, 0.3], atol=1e-12)


@pytest.mark.parametrize(("axis", "at"), PLACES[:2])
def test_convex_pieces_are_disjoint_and_fill_the_shape(check_pieces, name, axis, at):
    shape = moved(SHAPES[name], axis, at)
    volume = shape.mesh(SECTIONS).volume
    pieces = check_pieces(solid(shape), volume)
    assert sum(ConvexHull(piece).volume for piece in pieces) == pytest.approx(volume, rel=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.1, 3), st.floats(0.1, 3), st.floats(-2, 2), st.floats(0.1, 3))
def test_a_frustum_has_its_textbook_volume_and_centroid(polygon_area, a, b, low, height):
    volume, moment = cone(a, b, low, low + height).volume_and_moment(SECTIONS)
    kappa = polygon_area(1.0)
    assert float(volume) == pytest.approx(kappa * height / 3 * (a * a + a * b + b * b))
    share = (a * a + 2 * a * b + 3 * b * b) / (4 * (a * a + a * b + b * b))
    np.testing.assert_allclose(moment / volume, [0, 0, low + share * height], atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(3, 9), st.floats(0.1, 3), st.floats(-2, 2), st.floats(0.1, 3))
def test_a_prism_has_base_times_height(polygon_area, sides, radius, low, height):
    volume, moment = prism(polygon(sides, radius), low, low + height).volume_and_moment(SECTIONS)
    assert float(volume) == pytest.approx(polygon_area(radius, sides) * height)
    np.testing.assert_allclose(moment / volume, [0, 0, low + height / 2], atol=1e-9)


def test_a_ball_tends_to_the_sphere_as_sections_grow():
    errors = [1 - float(Ball(2.0).volume_and_moment(n)[0]) / (4 / 3 * np.pi * 8) for n in (12, 24, 48, 96)]
    assert errors[0] < 0.12 and errors[-1] < 0.002
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (np.abs(ratios - 4) < 0.2).all()  # second order
    assert np.linalg.norm(Ball(2.0).mesh(24).vertices, axis=1) == pytest.approx(2.0)


def test_a_lathe_obeys_pappus_with_many_sections():
    """Volume = area of the profile × way of its centroid; here a triangle of area 1/2 at radius 5/3."""
    triangle = np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    assert lathe(triangle, 1200).volume == pytest.approx(0.5 * 2 * np.pi * 5 / 3, rel=1e-5)


def test_a_polygon_is_counter_clockwise_from_x(polygon_area):
    outline = polygon(12, 2.0)
    assert outline[0].tolist() == [2, 0]
    np.testing.assert_allclose(np.linalg.norm(outline, axis=1), 2, rtol=1e-15)
    x, y = outline.T
    assert (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2 == pytest.approx(
        polygon_area(2.0, 12), rel=1e-14
    )
    assert polygon(6, np.ones((2, 3))).shape == (2, 3, 6, 2)


def test_extruded_points_are_the_outline_at_both_heights():
    points = extrude_points(polygon(6, 1.0), -0.5, 2.0)
    np.testing.assert_array_equal(points[:6], np.c_[polygon(6, 1.0), np.full(6, -0.5)])
    np.testing.assert_array_equal(points[6:], np.c_[polygon(6, 1.0), np.full(6, 2.0)])
