"""Every beginning of the order covers every parameter's range evenly."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.conftest import CONF, load_part

from pnet.parts.spread import spread_order

NAMES = sorted(path.stem for path in (CONF / "part").glob("*.yaml"))


def grid(*sizes: int) -> np.ndarray:
    """All combinations of so many values for each parameter, the first fastest, like a part's."""
    axes = [0.01 * (1 + axis) + 0.001 * np.arange(size) for axis, size in enumerate(sizes)]
    return np.array([row[::-1] for row in product(*axes[::-1])])


def counts(objects: np.ndarray) -> list[list[int]]:
    """How often each value of each parameter comes."""
    return [np.unique(column, return_counts=True)[1].tolist() for column in objects.T]


@pytest.mark.parametrize("name", NAMES)
def test_every_part_object_comes_once(name):
    for objects in load_part(name).grids.values():
        assert sorted(spread_order(objects)) == list(range(len(objects)))


@pytest.mark.parametrize("name", ["tn06", "tn16", "tn34", "tn42"])
@pytest.mark.parametrize("which", ["L", "G"])
def test_beginnings_of_4_8_16_32_objects_have_every_value_equally_often(name, which):
    objects = load_part(name).grids[which]
    order = spread_order(objects)
    for n in (4, 8, 16, 32, 64):
        if n <= len(objects):
            assert counts(objects[order[:n]]) == [[n // 4] * 4] * objects.shape[1], n


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_every_power_of_four_is_balanced(axes):
    objects = grid(*[4] * axes)
    order = spread_order(objects)
    for j in range(1, axes + 1):
        assert counts(objects[order[: 4**j]]) == [[4 ** (j - 1)] * 4] * axes


def test_the_first_sixteen_of_two_parameters_are_every_pair():
    """Of three parameters the first two: a sixteenth of a cube that looks like a square from above."""
    objects = grid(4, 4, 4)
    first = objects[spread_order(objects)[:16]]
    assert len(np.unique(first[:, :2], axis=0)) == 16


@pytest.mark.parametrize("name", ["tn06", "tn42"])
def test_thirds_and_fifths_hold_every_value_about_equally_often(name):
    """Table IV's 1/3 and 1/5 of 64 objects: 21, each value in five or six; 13, each in three or four."""
    objects = load_part(name).grids["L"]
    order = spread_order(objects)
    for n in (21, 13):
        for column in counts(objects[order[:n]]):
            assert len(column) == 4 and max(column) - min(column) <= 1, n


def test_by_hand():
    """Sobol's sequence in one dimension: 0, 1/2, 3/4, 1/4."""
    assert spread_order(grid(4)) == [0, 2, 3, 1]
    assert spread_order(grid(2)) == [0, 1]
    assert spread_order(grid(8))[:4] == [0, 4, 6, 2]


@pytest.mark.parametrize("axes", [1, 3, 5])
def test_a_single_object_is_the_order(axes):
    assert spread_order(grid(*[1] * axes)) == [0]


def test_parameters_of_one_value_change_nothing():
    objects = grid(4, 4)
    fixed = np.insert(objects, 2, 0.02, axis=1)
    assert spread_order(fixed) == spread_order(objects)


def test_only_the_values_order_counts():
    """Not their distances; and a grid that stands in another order gives the same objects."""
    objects = grid(4, 4, 2)
    order = spread_order(objects)
    assert spread_order(np.exp(300 * objects)) == order
    shuffled = np.random.default_rng(0).permutation(len(objects))
    np.testing.assert_array_equal(objects[shuffled][spread_order(objects[shuffled])], objects[order])


def test_a_grid_of_more_objects_than_draws_is_whole_too():
    order = spread_order(grid(9, 9, 9, 9))
    assert sorted(order) == list(range(6561))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=4))
def test_it_is_a_permutation_of_any_grid(sizes):
    objects = grid(*sizes)
    order = spread_order(objects)
    assert sorted(order) == list(range(len(objects)))
    assert {type(place) for place in order} == {int}
    assert spread_order(objects) == order


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from([1, 2, 4]), min_size=1, max_size=4))
def test_the_first_four_hold_every_value_of_a_grid_of_powers_of_two(sizes):
    objects = grid(*sizes)
    first = objects[spread_order(objects)[:4]]
    if len(first) == 4 and 4 in sizes:
        assert counts(first) == [[4 // size] * size for size in sizes]
