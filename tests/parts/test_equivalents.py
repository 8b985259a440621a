"""Equivalent places: a primitive's freedom carried through a symmetry group."""

import math

import pytest
import torch

from pnet.geometry.symmetry import cyclic, dihedral, full_group, reflection
from pnet.parts.equivalents import allowed, along_and_radial, distinct_images, images_of
from pnet.parts.primitives import Circle, Cylinder, Plane, Polygon, Sphere


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(
    ("primitive", "along"),
    [
        (Plane("x"), (1, 2, 3)),
        (Polygon(5), (1, 2, 3)),
        (Circle("z"), (0, 0, 3)),
        (Cylinder("-y"), (0, 2, 0)),
        (Cylinder((3, 0, 4), towards="y"), (1.8, 0, 2.4)),
        (Sphere(), (0, 0, 0)),
    ],
)
def test_a_step_splits_into_its_fixed_and_its_free_share(primitive, along):
    step = vector(1, 2, 3)
    fixed, free = along_and_radial(primitive, step)
    assert fixed.tolist() == pytest.approx(along)
    torch.testing.assert_close(fixed + free, step)


def test_steps_of_many_instances_are_split_at_once():
    fixed, free = along_and_radial(Circle("z"), torch.ones(2, 5, 3))
    assert fixed.shape == free.shape == (2, 5, 3) and fixed.dtype == torch.float32
    assert fixed[1, 4].tolist() == [0, 0, 1] and free[0, 2].tolist() == [1, 1, 0]


@pytest.mark.parametrize(
    ("group", "primitive", "step", "count"),
    [
        (dihedral(6).rotations, Plane("z"), (0, 0, 1), 2),
        (dihedral(6).rotations, Polygon(6), (1, 0, 0), 6),
        (dihedral(6).rotations, Plane("x"), (math.cos(0.1), math.sin(0.1), 0), 12),
        (dihedral(6).rotations, Circle("z"), (1, 0, 0), 1),
        (cyclic(4).rotations, Cylinder("x"), (0, 0, 1), 2),  # circles about x and about y
        (cyclic(4).rotations, Cylinder("x"), (1, 0, 1), 4),  # the same, off the centre
        (dihedral(3).rotations, Polygon(3), (1, 0, 0), 3),
        (full_group(cyclic(1), reflection((0, 1, 0))), Plane("y"), (0, 1, 0), 2),
        (full_group(cyclic(1), reflection((0, 1, 0))), Plane("x"), (1, 0, 0), 1),
        (dihedral(6).rotations, Sphere(), (0, 0, 1), 1),
    ],
)
def test_elements_that_carry_a_step_to_one_place_count_once(group, primitive, step, count):
    images, member = distinct_images(primitive, vector(*step)[None], group)
    assert images.shape == (count, 3, 3) and member.shape == (len(group),)
    assert torch.equal(images[0], torch.eye(3, dtype=torch.float64))
    assert member.bincount().tolist() == [len(group) // count] * count
    fixed, _ = along_and_radial(primitive, vector(*step))
    torch.testing.assert_close(group @ fixed, images[member] @ fixed, atol=1e-9, rtol=0)


def test_the_length_of_a_step_does_not_matter():
    for length in (1e-4, 1.0, 1e3):
        images, _ = distinct_images(Polygon(6), vector(length, 0, 0)[None], dihedral(6).rotations)
        assert len(images) == 6


def test_images_are_matrix_times_vector():
    group = cyclic(3).rotations
    vectors = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(0)).double()
    carried = images_of(vectors, group)
    assert carried.shape == (4, 5, 3, 3)
    for q in range(3):
        torch.testing.assert_close(carried[2, 1, q], group[q] @ vectors[2, 1])


def test_a_place_is_allowed_where_an_element_that_is_alive_makes_it():
    member = torch.tensor([0, 1, 1, 2])
    alive = torch.tensor([[True, False, False, False], [False, False, True, True]])
    may = allowed(alive, member, torch.zeros(2, 3))
    assert may.tolist() == [[True, False, False], [False, True, True]]
    assert allowed(None, member, torch.zeros(2, 3)).all()
