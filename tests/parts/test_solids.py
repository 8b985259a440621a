"""Shapes and their union and difference against closed forms, scipy's hulls and booleans of meshes."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from pnet.parts.solids import (
    Ball,
    Extrusion,
    Revolution,
    Shape,
    Solid,
    box,
    cone,
    cylinder,
    extrude_points,
    hole,
    lathe,
    moved,
    polygon,
    prism,
    solid,
)

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


def polygon_area(radius: float, sections: int = SECTIONS) -> float:
    return sections / 2 * radius**2 * np.sin(2 * np.pi / sections)


def check_pieces(body: Solid, volume: float, fill_holes: bool = False) -> list[np.ndarray]:
    """Each piece is its own hull's corners; their union has the volume."""
    pieces = body.pieces(SECTIONS, fill_holes)
    hulls = [trimesh.convex.convex_hull(piece) for piece in pieces]
    for piece, hull in zip(pieces, hulls, strict=True):
        assert len(ConvexHull(piece).vertices) <= len(piece) and hull.volume > 0
    assert trimesh.boolean.union(hulls, engine="manifold").volume == pytest.approx(volume, rel=0.01)
    return pieces


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
def test_convex_pieces_are_disjoint_and_fill_the_shape(name, axis, at):
    shape = moved(SHAPES[name], axis, at)
    volume = shape.mesh(SECTIONS).volume
    pieces = check_pieces(solid(shape), volume)
    assert sum(ConvexHull(piece).volume for piece in pieces) == pytest.approx(volume, rel=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.1, 3), st.floats(0.1, 3), st.floats(-2, 2), st.floats(0.1, 3))
def test_a_frustum_has_its_textbook_volume_and_centroid(a, b, low, height):
    volume, moment = cone(a, b, low, low + height).volume_and_moment(SECTIONS)
    kappa = polygon_area(1.0)
    assert float(volume) == pytest.approx(kappa * height / 3 * (a * a + a * b + b * b))
    share = (a * a + 2 * a * b + 3 * b * b) / (4 * (a * a + a * b + b * b))
    np.testing.assert_allclose(moment / volume, [0, 0, low + share * height], atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(3, 9), st.floats(0.1, 3), st.floats(-2, 2), st.floats(0.1, 3))
def test_a_prism_has_base_times_height(sides, radius, low, height):
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


def test_many_sizes_at_once_equal_one_by_one():
    r = np.array([[1.0, 1.5, 2.0], [0.5, 1.0, 3.0]])
    h = np.array([1.0, 2.0, 4.0])

    def make(r, h) -> Solid:
        plate = prism(polygon(6, 3 * r), 0.0, h)
        foot = moved(box((-r / 2, r), (-r, 0.0 * r), (-h, 0.0 * h)), "x", (h, -0.5, r + h))
        knob = moved(Ball(r / 3), "y", (0.0, r, 2.0))
        return (plate | foot | knob | cone(r, 0.0, h, 3 * h)) - hole(
            moved(cylinder(r / 4, 0.0, h), at=(r, h, 0.0))
        )

    volume, moment = make(r, h).signed_volume_and_moment(SECTIONS)
    assert volume.shape == (2, 3) and moment.shape == (2, 3, 3)
    for i, j in np.ndindex(2, 3):
        one, first = make(r[i, j], h[j]).signed_volume_and_moment(SECTIONS)
        assert float(volume[i, j]) == pytest.approx(float(one))
        np.testing.assert_allclose(moment[i, j], first, atol=1e-9)


def test_signed_sums_are_the_meshs_where_nothing_overlaps():
    body = (cylinder(2.0, 0.0, 1.0) | cylinder(1.0, 1.0, 3.0)) - hole(cylinder(0.5, 0.0, 3.0))
    mesh = body.mesh(SECTIONS)
    volume, moment = body.signed_volume_and_moment(SECTIONS)
    assert float(volume) == pytest.approx(polygon_area(2.0) + 2 * polygon_area(1.0) - 3 * polygon_area(0.5))
    assert mesh.volume == pytest.approx(float(volume), rel=1e-9)
    np.testing.assert_allclose(mesh.center_mass, moment / volume, atol=1e-9)
    assert mesh.is_watertight and mesh.euler_number == 0 and mesh.body_count == 1
    check_pieces(body, mesh.volume)


def test_overlapping_shapes_count_once_in_the_mesh_and_twice_in_the_sum():
    cross = box((-3.0, 3.0), (-1.0, 1.0), (0.0, 1.0)) | box((-1.0, 1.0), (-3.0, 3.0), (0.0, 1.0))
    assert float(cross.signed_volume_and_moment(SECTIONS)[0]) == pytest.approx(24)
    assert cross.mesh(SECTIONS).volume == pytest.approx(20)
    assert cross.mesh(SECTIONS).euler_number == 2
    check_pieces(cross, 20)


def test_steps_are_taken_in_order():
    """A plug added after the cut fills it again."""
    cube, bore = box((0.0, 2.0), (0.0, 2.0), (0.0, 2.0)), box((0.5, 1.5), (0.5, 1.5), (0.0, 2.0))
    assert (cube - bore).mesh(SECTIONS).volume == pytest.approx(6)
    assert ((cube - bore) | bore).mesh(SECTIONS).volume == pytest.approx(8)
    assert ((cube | bore) - bore).mesh(SECTIONS).volume == pytest.approx(6)
    assert sum(ConvexHull(p).volume for p in ((cube - bore) | bore).pieces(6, False)) == pytest.approx(8)


def test_crossed_drill_holes():
    cube = box((-2.0, 2.0), (-2.0, 2.0), (-2.0, 2.0))
    drills = [hole(moved(cylinder(0.8, -2.0, 2.0), axis)) for axis in "xyz"]
    body = cube - drills[0] - drills[1] - drills[2]
    mesh = body.mesh(SECTIONS)
    assert mesh.is_watertight and mesh.euler_number == 2 - 2 * 5  # six openings meet in a cavity: genus 5
    check_pieces(body, mesh.volume)
    assert len(body.pieces(SECTIONS, fill_holes=True)) == 1


def test_filling_leaves_out_holes_and_keeps_cuts():
    plate = box((0.0, 10.0), (0.0, 4.0), (0.0, 1.0))
    slot, bore = box((8.0, 10.0), (1.0, 3.0), (0.0, 1.0)), moved(cylinder(0.5, 0.0, 1.0), at=(3.0, 2.0, 0.0))
    body = plate - slot - hole(bore)
    check_pieces(body, 36 - polygon_area(0.5), fill_holes=False)
    check_pieces(body, 36, fill_holes=True)
    assert body.mesh(SECTIONS).volume == pytest.approx(36 - polygon_area(0.5))


def test_a_cut_through_leaves_two_bodies_and_a_cut_around_leaves_none():
    bar = box((0.0, 3.0), (0.0, 1.0), (0.0, 1.0))
    assert (bar - box((1.0, 2.0), (-1.0, 2.0), (-1.0, 2.0))).mesh(SECTIONS).body_count == 2
    gone = bar - box((-1.0, 4.0), (-1.0, 2.0), (-1.0, 2.0))
    assert len(gone.mesh(SECTIONS).faces) == 0 and gone.pieces(SECTIONS, False) == []


def test_constructions_that_are_not_plain_are_refused():
    a, b, c = (cylinder(r, 0.0, 1.0) for r in (3.0, 2.0, 1.0))
    with pytest.raises(ValueError, match=r"unite plain shapes first, then cut: \(a \| b\) - c"):
        _ = a | (b - c)
    with pytest.raises(ValueError, match=r"a - b - c, not a - \(b - c\)"):
        _ = a - (b - c)
    with pytest.raises(ValueError, match="axis 'w': choose x, y or z"):
        moved(a, "w")
    assert float((a - (b | c)).signed_volume_and_moment(SECTIONS)[0]) == pytest.approx(4 * polygon_area(1.0))


def test_a_polygon_is_counter_clockwise_from_x():
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
