"""Penetration by separating axes: by hand, against a naive twin, against linear programming."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from pnet.scenes.overlap import ConvexPiece, penetration

EYE, ORIGIN = np.eye(3), np.zeros(3)
UNIT = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def box(*size: float) -> np.ndarray:
    return UNIT * size


def depth(pieces, t, R=EYE) -> float:
    """How deep bodies of these corners reach into each other: one at the origin, the other at R, t."""
    return penetration([ConvexPiece(p) for p in pieces], EYE, ORIGIN, [(R, np.array(t, float))])


def naive_penetration(a: np.ndarray, b: np.ndarray) -> float:
    """The same of two corner arrays with every normal and every triangle's edges, as a textbook has it."""
    (na, ea), (nb, eb) = naive_axes(a), naive_axes(b)
    best = math.inf
    for axis in [*na, *nb, *(np.cross(u, v) for u in ea for v in eb)]:
        length = np.linalg.norm(axis)
        if length > 1e-6:
            for way in (axis / length, -axis / length):
                best = min(best, (a @ way).max() - (b @ way).min())
    return best


def naive_axes(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals and edge directions of a convex hull, each once."""
    hull = ConvexHull(corners)
    edges = np.concatenate([np.diff(corners[s[[0, 1, 2, 0]]], axis=0) for s in hull.simplices])
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    edges *= np.where(edges @ [1.0, np.e, np.pi] < 0, -1, 1)[:, None]
    return np.unique(hull.equations[:, :3].round(9), axis=0), np.unique(edges.round(9), axis=0)


def slack(a: np.ndarray, b: np.ndarray) -> float:
    """By linear programming: by how much two hulls' faces can all be moved in before no point is common."""
    faces = np.concatenate([ConvexHull(a).equations, ConvexHull(b).equations])
    limits = np.column_stack([faces[:, :3], np.ones(len(faces))])
    found = linprog([0, 0, 0, -1], limits, -faces[:, 3], bounds=[(None, None)] * 4)
    assert found.status == 0
    return float(found.x[3])


# by hand


@pytest.mark.parametrize(
    ("t", "expected"),
    [
        ((0.9, 0.3, 0.2), 0.1),
        ((0.3, -0.9, 0.2), 0.1),
        ((0.9, 0.95, 0.2), 0.05),
        ((0.0, 0.0, 0.0), 1.0),
        ((0.0, 0.0, -0.25), 0.75),
        ((1.0, 0.0, 0.0), 0.0),
        ((1.0, 1.0, 1.0), 0.0),
        ((1.2, 0.0, 0.0), -0.2),
    ],
)
def test_two_unit_cubes_side_by_side(t, expected):
    assert depth([UNIT], t) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("gap", [-0.1, -1e-6, 1e-6, 0.1])
def test_a_cube_turned_by_45_degrees_meets_another_with_its_edge(gap):
    turn = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    t = (0.5 + math.sqrt(0.5) + gap, 0.1, 0.2)
    assert depth([UNIT], t, turn) == pytest.approx(-gap, abs=1e-12)


def test_two_edges_that_cross_need_their_cross_product():
    """Both roofs' ridges at right angles, apart along z: no face normal separates them but z does."""
    roof = np.array([[-1, 0, 0], [1, 0, 0], [-1, 0.4, 1], [1, 0.4, 1], [-1, -0.4, 1], [1, -0.4, 1.0]])
    below = Rotation.from_euler("xz", [180, 90], degrees=True).as_matrix()
    for gap in (-0.05, 1e-4, 0.05):
        found = depth([roof], (0, 0, -gap), below)
        assert found == pytest.approx(-gap, abs=1e-9)
    normals = ConvexPiece(roof).normals
    overlap = [(roof @ n).max() - ((roof @ below.T - [0, 0, 0.05]) @ n).min() for n in normals]
    assert min(overlap) > 0


def test_a_small_box_inside_a_large_one_is_as_deep_as_its_way_out():
    """Half of both sizes; of two alike, so the small one is another piece of each body."""
    small, large = box(0.2, 0.2, 0.2), box(2, 2, 2) + np.array([10.0, 0, 0])
    # at 10 m the other body's small piece is in the middle of this one's large piece
    assert depth([small, large], (10, 0, 0)) == pytest.approx(1.1)


def test_pieces_of_two_bodies_are_tested_each_with_each():
    """A body of two cubes 3 m apart: another body fits between them, touches, or reaches in."""
    pieces = [UNIT + np.array([x, 0, 0]) for x in (-1.5, 1.5)]
    assert depth(pieces, (1.5, 0, 0)) == pytest.approx(-0.5)  # the other's left cube is in the middle
    assert depth(pieces, (2.2, 0, 0)) == pytest.approx(0.2)
    assert depth(pieces, (0, 0.9, 0)) == pytest.approx(0.1)
    assert depth(pieces, (3.0, 0, 0)) == pytest.approx(1.0)
    assert (
        penetration([ConvexPiece(np.concatenate(pieces))], EYE, ORIGIN, [(EYE, np.array([1.5, 0, 0]))]) > 0.9
    )


def test_the_deepest_of_several_bodies_counts():
    others = [(EYE, np.array(t)) for t in ((5.0, 0, 0), (0.8, 0, 0), (0, 0.7, 0))]
    assert penetration([ConvexPiece(UNIT)], EYE, ORIGIN, others) == pytest.approx(0.3)
    assert penetration([ConvexPiece(UNIT)], EYE, ORIGIN, others[:1]) == pytest.approx(-4)


def test_without_other_bodies_nothing_overlaps():
    assert penetration([ConvexPiece(UNIT)], EYE, ORIGIN, []) == -math.inf


def test_a_cube_has_six_normals_and_three_edge_directions():
    piece = ConvexPiece(UNIT)
    np.testing.assert_allclose(
        sorted(map(tuple, piece.normals)), sorted(map(tuple, [*EYE, *-EYE])), atol=1e-12
    )
    np.testing.assert_allclose(sorted(map(tuple, piece.edges)), sorted(map(tuple, EYE)), atol=1e-12)


# whatever the bodies

numbers = st.floats(-1, 1).map(lambda x: round(x, 3))
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


@st.composite
def bodies(draw, least: int = 4, most: int = 9) -> np.ndarray:
    """Corners of a convex body that is not flat."""
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    corners = rng.uniform(-1, 1, (draw(st.integers(least, most)), 3))
    assume(ConvexHull(corners).volume > 0.05)
    return corners


turns = st.integers(0, 10**6).map(lambda seed: Rotation.random(rng=seed).as_matrix())


@settings(max_examples=60, deadline=None)
@given(bodies(), turns, vectors)
def test_any_two_bodies_overlap_as_their_naive_twin_says(corners, R, t):
    expected = naive_penetration(corners, corners @ R.T + 1.5 * t)
    found = depth([corners], 1.5 * t, R)
    if expected > 0:
        assert found == pytest.approx(expected, abs=1e-7)
    else:
        assert expected - 1e-7 <= found <= 1e-7  # a bound of the distance suffices there


@settings(max_examples=150, deadline=None)
@given(bodies(), turns, vectors)
def test_any_two_bodies_overlap_where_linear_programming_finds_a_common_point(corners, R, t):
    common = slack(corners, corners @ R.T + 1.5 * t)
    assume(abs(common) > 1e-7)
    found = depth([corners], 1.5 * t, R)
    assert (found > 0) == (common > 0)
    if common > 0:
        # a ball of that radius fits into both, so at least its diameter has to be moved out
        assert found >= 2 * common - 1e-9


@settings(max_examples=40, deadline=None)
@given(bodies(), turns, vectors)
def test_no_way_shorter_than_the_depth_parts_two_bodies(corners, R, t):
    found = depth([corners], t, R)
    assume(found > 1e-3)
    for way in Rotation.random(12, rng=0).as_matrix()[:, 0]:
        assert depth([corners], t + 0.99 * found * way, R) > 0


@settings(max_examples=40, deadline=None)
@given(bodies(), turns, vectors, turns, vectors, st.booleans())
def test_order_and_a_common_motion_change_nothing(corners, R, t, turn, shift, two):
    pieces = [ConvexPiece(corners), ConvexPiece(corners + np.array([1.0, 0.5, 0]))][: 1 + two]
    first = penetration(pieces, EYE, ORIGIN, [(R, t)])
    swapped = penetration(pieces, R, t, [(EYE, ORIGIN)])
    moved = penetration(pieces, turn, shift, [(turn @ R, turn @ t + shift)])
    assert moved == pytest.approx(first, abs=1e-9)
    assert (swapped > 0) == (first > 0)
    if first > 0:
        assert swapped == pytest.approx(first, abs=1e-9)


def test_a_real_part_overlaps_as_the_naive_twin_says(tn34):
    """A piece with many coplanar triangles and nearly parallel edges."""
    piece = tn34.convex_pieces(tn34.part_object("L", 0), True)[0]
    rng = np.random.default_rng(0)
    for share in (0.3, 0.9):
        R, t = (
            Rotation.random(rng=rng).as_matrix(),
            share * np.ptp(piece, axis=0).min() * np.array([0.6, 0, 0.8]),
        )
        expected = naive_penetration(piece, piece @ R.T + t)
        assert depth([piece], t, R) == pytest.approx(expected, abs=1e-7) and expected > 0.001
