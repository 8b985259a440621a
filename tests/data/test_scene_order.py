"""Orders of training scenes: fair, endless, and functions of the seed."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnet.data.scene_order import Mixture, Permutations, mixed_order


@given(size=st.integers(1, 9), seed=st.integers(0, 5), turn=st.integers(0, 20))
def test_every_turn_is_a_permutation_of_the_scenes(size, seed, turn):
    scenes = [3 * i + 1 for i in range(size)]
    order = Permutations(scenes, seed)
    assert sorted(order[turn * size + i] for i in range(size)) == scenes


def test_the_permutations_are_the_generators_own():
    expected = [int(i) for turn in (0, 1) for i in np.random.default_rng([3, turn]).permutation(7)]
    order = Permutations(range(7), 3)
    assert [order[i] for i in range(14)] == expected
    assert [order[i] for i in (13, 0, 8)] == [expected[i] for i in (13, 0, 8)]  # in any order


def test_streams_of_one_seed_differ():
    first, second = (Permutations(range(50), 0, stream) for stream in (0, 1))
    assert [first[i] for i in range(50)] != [second[i] for i in range(50)]


@given(share=st.fractions(0, 1, max_denominator=60), block=st.integers(0, 9), seed=st.integers(0, 3))
def test_a_mixture_keeps_its_share_in_every_block(share, block, seed):
    mixed = Mixture(Permutations([0], 0), Permutations([1], 0), float(share), seed)
    n = share.denominator
    assert sum(mixed[block * n + i] for i in range(n)) == share.numerator


@pytest.mark.parametrize(("share", "world"), [(0.5, 2), (0.25, 4), (0.6, 5)])
def test_every_process_of_several_sees_the_share(share, world):
    mixed = Mixture(Permutations([0], 0), Permutations([1], 0), share, 0)
    for rank in range(world):
        seen = [mixed[i] for i in range(rank, 4000, world)]
        assert np.mean(seen) == pytest.approx(share, abs=0.1)


@given(share=st.sampled_from([0.25, 0.6, 0.9]), a=st.integers(1, 7), b=st.integers(1, 7))
def test_a_mixture_goes_through_both_orders_in_turn(share, a, b):
    first, second = Permutations(range(a), 1, 0), Permutations(range(a, a + b), 1, 1)
    mixed = Mixture(first, second, share, 0)
    row = [mixed[i] for i in range(200)]
    for order, scenes in ((first, range(a)), (second, range(a, a + b))):
        own = [i for i in row if i in scenes]
        assert own == [order[i] for i in range(len(own))]


def test_a_mixture_does_not_lose_its_share_far_out():
    mixed = Mixture(Permutations([0], 0), Permutations([1], 0), 0.3, 0)
    far = 10**15
    assert sum(mixed[far + i] for i in range(1000)) == 300


KINDS = ["pile", "clutter", "pile", "clutter", "clutter"]


def test_without_a_share_every_scene_comes_equally_often():
    order = mixed_order(KINDS, 0, None)
    assert Counter(order[i] for i in range(50)) == dict.fromkeys(range(5), 10)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 1.0])
def test_the_share_of_clutter_is_the_one_asked_for(share):
    order = mixed_order(KINDS, 0, share)
    drawn = [KINDS[order[i]] for i in range(100)]
    assert drawn.count("clutter") == 100 * share and len(order) == 5


def test_scenes_of_one_kind_come_equally_often():
    order = mixed_order(KINDS, 0, 0.5)
    assert Counter(order[i] for i in range(120)) == {0: 30, 2: 30, 1: 20, 3: 20, 4: 20}


@pytest.mark.parametrize(("kinds", "share"), [(["pile"], 0.5), (["pile"], 1.0), (["clutter"], 0.5)])
def test_a_kind_that_is_not_there_is_named(kinds, share):
    lacking = "pile" if kinds == ["clutter"] else "clutter"
    with pytest.raises(ValueError, match=rf"data\.clutter=.* kind {lacking}, but training has none"):
        mixed_order(kinds, 0, share)


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_outside_its_range_is_refused(share):
    with pytest.raises(ValueError, match=r"data\.clutter is .*expected a share in"):
        mixed_order(KINDS, 0, share)
