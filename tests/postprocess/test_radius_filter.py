"""The radius filter against a double loop."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.postprocess.radius_filter import RadiusFilter

RF = RadiusFilter(radius=0.01, neighbours=3, widen=0.002, max_radius=0.02, enough=0.1)


def naive(rf: RadiusFilter, votes: torch.Tensor, labels: torch.Tensor) -> list[bool]:
    """Vote by vote, radius by radius."""
    kept = [False] * len(votes)
    for cluster in sorted(set(labels.tolist()) - {-1}):
        members = [i for i, label in enumerate(labels.tolist()) if label == cluster]
        radius = rf.radius
        while True:
            near = {
                i: sum(float((votes[i] - votes[j]).norm()) <= radius for j in members if j != i)
                for i in members
            }
            passed = [i for i in members if near[i] >= rf.neighbours]
            if len(passed) / len(members) >= rf.enough or radius + rf.widen > rf.max_radius + 1e-9:
                break
            radius += rf.widen
        for i in passed or members:
            kept[i] = True
    return kept


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 40),
    d=st.integers(1, 4),
    neighbours=st.integers(0, 6),
    enough=st.sampled_from([0.1, 0.4, 0.9]),
)
def test_it_is_the_naive_loop_and_never_loses_a_cluster(seed, n, d, neighbours, enough):
    generator = torch.Generator().manual_seed(seed)
    votes = 0.03 * torch.rand(n, 3, generator=generator, dtype=torch.float64)
    labels = torch.randint(-1, d, (n,), generator=generator)
    rf = replace(RF, neighbours=neighbours, enough=enough)
    kept = rf(votes, labels)
    assert kept.tolist() == naive(rf, votes, labels)
    assert set(labels[kept].tolist()) == set(labels.tolist()) - {-1}


def row(*x: float) -> torch.Tensor:
    return torch.tensor([[value, 0, 0] for value in x], dtype=torch.float64)


def test_a_vote_that_stands_alone_is_not_counted():
    votes = row(0, 0.001, 0.002, 0.003, 0.1)
    assert RF(votes, torch.zeros(5).long()).tolist() == [True] * 4 + [False]


def test_votes_of_another_cluster_do_not_help():
    votes = row(0, 0.001, 0.002, 0.003, 0.0015)
    assert RF(votes, torch.tensor([0, 0, 0, 0, 1])).tolist() == [True] * 5  # alone in its cluster: kept
    labels = torch.tensor([0, 0, 0, 0, -1])
    assert RF(votes, labels).tolist() == [True] * 4 + [False]


def test_the_radius_widens_until_enough_are_left():
    votes = row(0, 0.013, 0.026, 0.2)
    rf = replace(RF, neighbours=2)
    assert rf(votes, torch.zeros(4).long()).tolist() == [False, True, False, False]  # at 14 mm
    narrow = replace(rf, max_radius=0.012)
    assert narrow(votes, torch.zeros(4).long()).tolist() == [True] * 4  # nothing is dense: all count
    # without widening there is one pass
    assert replace(rf, widen=0.0)(votes, torch.zeros(4).long()).tolist() == [True] * 4


def test_the_largest_radius_is_tried_too():
    """0.01 + 5 · 0.002 exceeds 0.02 by a rounding error."""
    votes = row(0, 0.019, 0.038, 0.2)
    assert replace(RF, neighbours=2)(votes, torch.zeros(4).long()).tolist() == [False, True, False, False]


def test_exactly_enough_is_enough():
    votes = row(*[0.0] * 9, 0.015)  # nine of ten; at 16 mm the tenth would be kept as well
    kept = replace(RF, enough=0.9)(votes, torch.zeros(10).long())
    assert kept.tolist() == [True] * 9 + [False]


def test_clusters_without_neighbours_at_all_keep_their_votes():
    votes = row(0, 1, 2)
    assert RF(votes, torch.zeros(3).long()).all()


@pytest.mark.parametrize("labels", [[], [-1, -1]])
def test_without_clusters_nothing_is_kept(labels):
    kept = RF(torch.zeros(len(labels), 3), torch.tensor(labels).long())
    assert kept.tolist() == [False] * len(labels)
