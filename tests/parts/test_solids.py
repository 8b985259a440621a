"""Prisms, lathes and ring sectors against closed forms and scipy's hulls."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from pnet.parts.solids import circle, extrude_points, lathe, prism, ring_sectors


def polygon_area(radius: float, sections: int) -> float:
    return sections / 2 * radius**2 * np.sin(2 * np.pi / sections)


def test_a_circle_is_a_counter_clockwise_regular_polygon_from_x():
    outline = circle(2.0, 12)
    assert outline[0].tolist() == [2, 0]
    np.testing.assert_allclose(np.linalg.norm(outline, axis=1), 2, rtol=1e-15)
    x, y = outline.T
    shoelace = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2
    assert shoelace == pytest.approx(polygon_area(2.0, 12), rel=1e-14)


@settings(max_examples=20, deadline=None)
@given(st.floats(1e-3, 1.0), st.sampled_from([6, 12, 48]), st.floats(1e-3, 1.0))
def test_a_prism_has_base_times_height(radius, sections, height):
    solid = prism(circle(radius, sections), -height, 0.0)
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume == pytest.approx(polygon_area(radius, sections) * height, rel=1e-9)
    np.testing.assert_allclose(solid.bounds[:, 2], [-height, 0])


@pytest.mark.parametrize("sections", [6, 48])
def test_a_lathe_of_a_rectangle_is_a_straight_ring(sections):
    profile = np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 3.0], [1.0, 3.0]])
    ring = lathe(profile, sections)
    assert ring.is_watertight and ring.euler_number == 0
    expected = 3 * (polygon_area(2.0, sections) - polygon_area(1.0, sections))
    assert ring.volume == pytest.approx(expected, rel=1e-12)
    assert ring.bounds[:, 2].tolist() == [0, 3]


def test_a_lathe_obeys_pappus_with_many_sections():
    """Volume = area of the profile × way of its centroid; here a triangle of area 1/2 at radius 5/3."""
    triangle = np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    assert lathe(triangle, 1200).volume == pytest.approx(0.5 * 2 * np.pi * 5 / 3, rel=1e-5)


def test_extruded_points_are_the_outline_at_both_heights():
    outline = circle(1.0, 6)
    points = extrude_points(outline, -0.5, 2.0)
    assert points.shape == (12, 3)
    np.testing.assert_array_equal(points[:6], np.c_[outline, np.full(6, -0.5)])
    np.testing.assert_array_equal(points[6:], np.c_[outline, np.full(6, 2.0)])


def test_ring_sectors_fill_the_ring_without_overlap():
    inner, outer = circle(1.0, 12), circle(2.0, 12)
    sectors = ring_sectors(inner, outer, 0.0, 3.0)
    assert [sector.shape for sector in sectors] == [(8, 3)] * 12
    volumes = [ConvexHull(sector).volume for sector in sectors]
    expected = 3 * (polygon_area(2.0, 12) - polygon_area(1.0, 12))
    np.testing.assert_allclose(volumes, expected / 12, rtol=1e-12)
    union = trimesh.boolean.union([trimesh.convex.convex_hull(s) for s in sectors], engine="manifold")
    assert union.volume == pytest.approx(expected, rel=1e-6)
