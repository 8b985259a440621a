"""Solids that a template may get wrong, and where its centroid comes from."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.geometry.symmetry import cyclic
from pnet.parts.base import ParametricPart
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint
from pnet.parts.shapes import Ball
from pnet.parts.solids import box, cylinder, hole, moved

MM = 0.001


class Bar(ParametricPart):
    """A square bar of length l, 10 mm wide, with whatever a test makes of it at a."""

    name = "bar"
    parameter_names = ("l", "a")
    symmetry = cyclic(1)
    keypoints = (
        Keypoint("end", "centroid", Plane("-x", at=0)),
        Keypoint("far", "end", Plane("x"), "l"),
        Keypoint("up", "centroid", Plane("z"), "a"),
    )

    def __init__(self, work, learning, generalization=None) -> None:
        self.work = work
        super().__init__(learning, generalization, sections=24)

    def solid(self, parameters):
        length, a = self.split(parameters)
        return self.work(box((0 * length, length), (-5 * MM, 5 * MM), (-5 * MM, 5 * MM)), length, a)


def parameters(length: float, a: float) -> np.ndarray:
    return np.array([length, a]) * MM


def drilled(bar, length, a):
    return bar - hole(moved(cylinder(2 * MM, -5 * MM, 5 * MM), at=(a, 0.0, 0.0)))


def with_knob(bar, length, a):
    return bar | moved(Ball(a), at=(length, 0.0, 5 * MM))


def sawn(bar, length, a):
    return bar - box((a, a + 4 * MM), (-9 * MM, 9 * MM), (-9 * MM, 9 * MM))


GRID = {"l": [30, 40], "a": [10, 20]}


def check_centroid(part: ParametricPart, grid: np.ndarray) -> None:
    centroids = part.centroid(grid)
    for row, centroid in zip(grid, centroids, strict=True):
        body = part.solid(row).mesh(24)
        np.testing.assert_allclose(centroid, body.center_mass, atol=1e-9)
        assert np.abs(part.mesh(row).center_mass).max() < 1e-9


def test_the_closed_form_centroid_is_the_meshs():
    part = Bar(drilled, GRID)
    check_centroid(part, part.grids["L"])
    assert part.closed_form


@settings(max_examples=10, deadline=None)
@given(st.floats(8, 22), st.floats(30, 50))
def test_the_closed_form_centroid_of_a_drilled_bar_is_the_textbooks(a, length):
    part = Bar(drilled, GRID)
    bore = 12 * 4 * np.sin(2 * np.pi / 24) * 10
    expected = (100 * length**2 / 2 - bore * a) / (100 * length - bore)
    np.testing.assert_allclose(
        1000 * part.centroid(parameters(length, a)[None])[0], [expected, 0, 0], atol=1e-9
    )


def test_overlapping_shapes_have_their_meshs_centroid():
    part = Bar(with_knob, {"l": [30], "a": [6, 8]})
    check_centroid(part, part.grids["L"])
    assert not part.closed_form


def test_a_cut_beyond_the_border_has_its_meshs_centroid():
    def work(bar, length, a):
        return bar - moved(cylinder(a, -9 * MM, 9 * MM), at=(length, 0.0, 0.0))

    part = Bar(work, {"l": [30], "a": [3, 4]})
    check_centroid(part, part.grids["L"])


def test_shapes_that_overlap_in_some_part_objects_only_have_their_meshs_centroid():
    """Blocks from length - 24 and from a: they overlap in the second and third combination alone."""

    def work(bar, length, a):
        block = box((length - 24 * MM, length - 14 * MM), (-5 * MM, 5 * MM), (5 * MM, 15 * MM))
        return bar | block | box((a, a + 6 * MM), (-5 * MM, 5 * MM), (5 * MM, 25 * MM))

    part = Bar(work, {"l": [40, 30], "a": [5, 20]}, {"l": [35], "a": [12]})
    check_centroid(part, part.grids["L"])
    check_centroid(part, part.grids["G"])


@pytest.mark.parametrize("size", [(30, 10), (40, 20)])
def test_a_solid_that_falls_apart_says_so(size):
    part = Bar(sawn, GRID)
    text = (
        rf"bar: the solid falls into 2 pieces with l = {size[0]} mm, a = {size[1]} mm; a cut goes through it"
    )
    with pytest.raises(ValueError, match=text):
        part.mesh(parameters(*size))


def test_added_shapes_that_do_not_touch_fall_apart():
    part = Bar(lambda bar, length, a: bar | moved(Ball(2 * MM), at=(length + a, 0.0, 0.0)), GRID)
    with pytest.raises(ValueError, match=r"falls into 2 pieces .* added shapes don't touch"):
        part.mesh(parameters(30, 10))


def test_a_solid_of_which_nothing_is_left_says_so():
    def work(bar, length, a):
        return bar - box((-a, length + a), (-9 * MM, 9 * MM), (-9 * MM, 9 * MM))

    with pytest.raises(ValueError, match=r"bar: nothing is left of the solid with l = 30 mm, a = 10 mm"):
        Bar(work, {"l": [30], "a": [10]}).mesh(parameters(30, 10))


def test_a_shape_that_turns_inside_out_is_refused_at_once():
    def work(bar, length, a):
        return bar | box((a, length - a), (-5 * MM, 5 * MM), (5 * MM, 8 * MM))

    with pytest.raises(ValueError, match=r"bar: the solid's extrusion vanishes .*l = 30 mm, a = 15 mm"):
        Bar(work, {"l": [40, 30], "a": [10, 15]})
    with pytest.raises(ValueError, match=r"vanishes or turns inside out with l = 30 mm, a = 16 mm"):
        Bar(work, {"l": [40]} | {"a": [10]}, {"l": [30, 40], "a": [10, 16]})
    Bar(work, {"l": [40, 30], "a": [10, 14.9]})


@pytest.mark.parametrize("radius", [-1.0, np.nan])
def test_a_radius_that_is_negative_or_no_number_is_refused(radius):
    """A profile beyond its axis is wound the other way round though its volume stays positive."""

    def work(bar, length, a):
        return bar | moved(cylinder(radius * a, 5 * MM, 9 * MM), at=(length / 2, 0.0, 0.0))

    with pytest.raises(ValueError, match=r"bar: the solid's revolution vanishes or turns inside out"):
        Bar(work, {"l": [30], "a": [4]})
