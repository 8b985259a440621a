"""A convex body less a convex cutter: pieces that add up, are disjoint and keep clear of the cutter."""

from itertools import combinations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from pnet.parts.clipping import convex_difference
from pnet.parts.shapes import extrude_points, polygon
from pnet.parts.solids import cone, cylinder, moved

CUBE = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T.astype(float)


def cuboid(low, high) -> np.ndarray:
    return np.array(low, float) + CUBE * (np.array(high, float) - low)


def volume(points: np.ndarray) -> float:
    return ConvexHull(points).volume


def common(*bodies: np.ndarray) -> float:
    """Volume that all hulls share, by an independent boolean."""
    return trimesh.boolean.intersection(
        [trimesh.convex.convex_hull(points) for points in bodies], engine="manifold"
    ).volume


def check_difference(body: np.ndarray, cutter: np.ndarray) -> list[np.ndarray]:
    """Volumes add up; no two pieces share any; none reaches into the cutter or out of the body."""
    pieces = convex_difference(body, cutter)
    left = volume(body) - common(body, cutter)
    assert sum(map(volume, pieces)) == pytest.approx(left, rel=1e-5, abs=1e-7 * volume(body))
    for piece in pieces:
        assert len(ConvexHull(piece).vertices) == len(piece)  # corners only
        assert common(piece, cutter) < 1e-5 * volume(body)
        assert common(piece, body) == pytest.approx(volume(piece), rel=1e-5, abs=1e-7 * volume(body))
    for one, other in combinations(pieces, 2):
        assert common(one, other) < 1e-5 * volume(body)
    return pieces


@pytest.mark.parametrize(
    ("low", "high", "count"),
    [
        ((0.25, 0.25, 0.25), (0.75, 0.75, 0.75), 6),  # a cavity
        ((0.25, 0.25, -1), (0.75, 0.75, 2), 4),  # a hole through
        ((0.25, 0.25, 0), (0.75, 0.75, 1), 4),  # the same, ends flush
        ((0.5, -1, -1), (2, 2, 2), 1),  # a half off
        ((0.5, 0.5, 0.5), (2, 2, 2), 3),  # a corner off
        ((0.4, -1, -1), (0.6, 2, 2), 2),  # a slot
        ((0.25, 0.25, 0.5), (0.75, 0.75, 2), 5),  # a blind hole
    ],
)
def test_a_cuboid_is_cut_from_a_cube(low, high, count):
    assert len(check_difference(CUBE, cuboid(low, high))) == count


@pytest.mark.parametrize(
    "cutter",
    [
        cuboid((2, 2, 2), (3, 3, 3)),
        cuboid((1.1, -1, -1), (2, 2, 2)),
        cuboid((1, 0, 0), (2, 1, 1)),  # touches a face
        cuboid((1, 1, 0), (2, 2, 1)),  # touches an edge
        cuboid((1, 1, 1), (2, 2, 2)),  # touches a corner
        extrude_points(np.array([[2.2, 0.0], [2.2, 2.2], [0.2, 2.2]]), 0, 1),  # clear, though its box is not
    ],
)
def test_a_cutter_outside_or_only_touching_leaves_the_body_as_it_is(cutter):
    pieces = convex_difference(CUBE, cutter)
    assert len(pieces) == 1 and np.array_equal(pieces[0], CUBE)


@pytest.mark.parametrize("cutter", [cuboid((-1, -1, -1), (2, 2, 2)), CUBE, cuboid((0, 0, -1), (1, 1, 1))])
def test_a_cutter_that_holds_the_body_leaves_nothing(cutter):
    assert convex_difference(CUBE, cutter) == []


@pytest.mark.parametrize("sections", [6, 24, 48])
def test_a_round_hole_leaves_a_piece_for_each_side_of_it(sections):
    drill = cylinder(0.3, -1.0, 2.0).pieces(sections)[0] + [0.5, 0.5, 0]
    pieces = convex_difference(CUBE, drill)
    expected = 1 - sections / 2 * 0.09 * np.sin(2 * np.pi / sections)
    assert len(pieces) == sections
    assert sum(map(volume, pieces)) == pytest.approx(expected, rel=1e-9)


def test_crossed_and_conical_cutters():
    drill = moved(cylinder(0.2, -2.0, 2.0), "x", (0.0, 0.45, 0.55)).pieces(12)[0]
    check_difference(CUBE, drill)
    sink = moved(cone(0.1, 0.6, 0.5, 1.2), "z", (0.5, 0.5, 0.0)).pieces(12)[0]
    check_difference(CUBE, sink)


def test_millimetre_bodies_are_cut_as_well_as_metre_ones():
    body = extrude_points(polygon(6, 0.012), -0.004, 0.004)
    drill = cylinder(0.007, -0.004, 0.004).pieces(48)[0]
    pieces = convex_difference(body, drill)
    expected = 0.008 * (1.5 * np.sqrt(3) * 0.012**2 - 24 * 0.007**2 * np.sin(np.pi / 24))
    assert sum(map(volume, pieces)) == pytest.approx(expected, rel=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.floats(-0.8, 0.8), st.floats(0.2, 2.0))
def test_any_two_convex_bodies(seed, shift, size):
    rng = np.random.default_rng(seed)
    body = rng.normal(size=(12, 3))
    cutter = size * rng.normal(size=(8, 3)) + [shift, 0, 0]
    check_difference(body[ConvexHull(body).vertices], cutter[ConvexHull(cutter).vertices])
