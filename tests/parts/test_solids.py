"""Union and difference of shapes against closed forms and booleans of meshes."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pnet.parts.shapes import Ball, polygon
from pnet.parts.solids import Solid, box, cone, cylinder, hole, moved, prism

SECTIONS = 24


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


def test_signed_sums_are_the_meshs_where_nothing_overlaps(check_pieces, polygon_area):
    body = (cylinder(2.0, 0.0, 1.0) | cylinder(1.0, 1.0, 3.0)) - hole(cylinder(0.5, 0.0, 3.0))
    mesh = body.mesh(SECTIONS)
    volume, moment = body.signed_volume_and_moment(SECTIONS)
    assert float(volume) == pytest.approx(polygon_area(2.0) + 2 * polygon_area(1.0) - 3 * polygon_area(0.5))
    assert mesh.volume == pytest.approx(float(volume), rel=1e-9)
    np.testing.assert_allclose(mesh.center_mass, moment / volume, atol=1e-9)
    assert mesh.is_watertight and mesh.euler_number == 0 and mesh.body_count == 1
    check_pieces(body, mesh.volume)


def test_overlapping_shapes_count_once_in_the_mesh_and_twice_in_the_sum(check_pieces):
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


def test_crossed_drill_holes(check_pieces):
    cube = box((-2.0, 2.0), (-2.0, 2.0), (-2.0, 2.0))
    drills = [hole(moved(cylinder(0.8, -2.0, 2.0), axis)) for axis in "xyz"]
    body = cube - drills[0] - drills[1] - drills[2]
    mesh = body.mesh(SECTIONS)
    assert mesh.is_watertight and mesh.euler_number == 2 - 2 * 5  # six openings meet in a cavity: genus 5
    check_pieces(body, mesh.volume)
    assert len(body.pieces(SECTIONS, fill_holes=True)) == 1


def test_filling_leaves_out_holes_and_keeps_cuts(check_pieces, polygon_area):
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


def test_constructions_that_are_not_plain_are_refused(polygon_area):
    a, b, c = (cylinder(r, 0.0, 1.0) for r in (3.0, 2.0, 1.0))
    with pytest.raises(ValueError, match=r"unite plain shapes first, then cut: \(a \| b\) - c"):
        _ = a | (b - c)
    with pytest.raises(ValueError, match=r"a - b - c, not a - \(b - c\)"):
        _ = a - (b - c)
    with pytest.raises(ValueError, match="axis 'w': choose x, y or z"):
        moved(a, "w")
    assert float((a - (b | c)).signed_volume_and_moment(SECTIONS)[0]) == pytest.approx(4 * polygon_area(1.0))
