"""Means and spreads of votes."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from pnet.postprocess.vote import MeanVote, PointVotes, vote, vote_spread

LABELS = torch.tensor([1, 0, 1, -1, 1, 0])
KEPT = torch.tensor([True, True, True, False, False, True])


def test_means_by_hand():
    values = torch.tensor([1.0, 10, 3, 100, 1000, 20])
    assert vote(values, LABELS, KEPT, 2).tolist() == [15, 2]


def test_values_may_be_points():
    values = torch.arange(18.0).view(6, 3)
    means = vote(values, LABELS, KEPT, 2)
    torch.testing.assert_close(means, torch.stack([values[[1, 5]].mean(0), values[[0, 2]].mean(0)]))


def test_spread_is_the_root_mean_square_distance():
    values = torch.tensor([[3.0, 0, 0], [0, 1, 0], [-3, 0, 0], [9, 9, 9], [9, 9, 9], [0, 1, 0]])
    means = vote(values, LABELS, KEPT, 2)
    torch.testing.assert_close(vote_spread(values, LABELS, KEPT, means), torch.tensor([0.0, 3.0]))


@given(seed=st.integers(0, 10**6), d=st.integers(1, 5))
def test_against_one_cluster_at_a_time(seed, d):
    generator = torch.Generator().manual_seed(seed)
    labels = torch.cat([torch.arange(d), torch.randint(-1, d, (30,), generator=generator)])
    kept = (labels >= 0) & (torch.rand(len(labels), generator=generator) < 0.7)
    kept[:d] = True
    values = torch.randn(len(labels), 3, generator=generator, dtype=torch.float64)
    means = vote(values, labels, kept, d)
    spread = vote_spread(values, labels, kept, means)
    for c in range(d):
        own = values[kept & (labels == c)]
        torch.testing.assert_close(means[c], own.mean(0))
        torch.testing.assert_close(spread[c], own.var(0, correction=0).sum().sqrt())


def three_votes_of_two_flanges() -> PointVotes:
    """Base, top and rim at hand; cluster 0 has points 0 and 2, cluster 1 point 3, point 1 belongs to none."""
    first = torch.tensor([[0.0, 0, -4], [0, 0, 6], [12, 0, -4]], dtype=torch.float64)
    second = torch.tensor([[0.0, 0, -2], [0, 0, 12], [0, 20, -2]], dtype=torch.float64)
    wild = torch.full((3, 3), 500.0, dtype=torch.float64)
    centroid = torch.tensor([[1.0, 0, 0], [500, 0, 0], [3, 0, 0], [0, 7, 0]], dtype=torch.float64)
    owner = torch.tensor([0, -1, 0, 1])
    reliable = (owner >= 0)[:, None].repeat(1, 4)
    return PointVotes(centroid, torch.stack([first, wild, first + 2, second]), owner, 2, reliable)


def test_the_mean_vote_by_hand(tn34):
    agreed = MeanVote()(tn34, three_votes_of_two_flanges())
    assert agreed.centroid.tolist() == [[2, 0, 0], [0, 7, 0]]
    assert agreed.keypoints.tolist() == [
        [[1, 1, -3], [1, 1, 7], [13, 1, -3]],
        [[0, 0, -2], [0, 0, 12], [0, 20, -2]],
    ]
    assert agreed.parameters.tolist() == [[12, 10], [20, 14]]  # r, h
    expected = torch.tensor([[1, *[3**0.5] * 3], [0, 0, 0, 0]], dtype=torch.float64)
    torch.testing.assert_close(agreed.spread, expected)


def test_unreliable_votes_leave_the_mean_but_not_the_parameters(tn34):
    """The radius filter judges places; parameters are measured at every point of the cluster, as in M_P."""
    votes = three_votes_of_two_flanges()
    votes.reliable[2, 1:3] = False
    votes.keypoints[2, 2] += torch.tensor([4.0, 0, 0])
    agreed = MeanVote()(tn34, votes)
    assert agreed.keypoints[0].tolist() == [[0, 0, -4], [0, 0, 6], [15, 1, -3]]
    assert agreed.centroid[0].tolist() == [2, 0, 0]
    assert agreed.spread[0, 1:3].tolist() == [0, 0]
    assert agreed.parameters[0].tolist() == [14, 10]


def test_a_mean_of_different_equivalents_is_none_of_them(tn06):
    """Half the votes for the upper face, half for the lower: the plain mean is the centroid."""
    local = tn06.chain.keypoints_from_parameters(torch.tensor([0.004, 0.011, 0.014], dtype=torch.float64))
    flip = torch.tensor([1.0, -1, -1], dtype=torch.float64)
    keypoints = torch.stack([local, local * flip])
    owner, reliable = torch.zeros(2, dtype=torch.long), torch.ones(2, 4, dtype=torch.bool)
    agreed = MeanVote()(tn06, PointVotes(torch.zeros(2, 3).double(), keypoints, owner, 1, reliable))
    assert agreed.keypoints[0, 0].tolist() == [0, 0, 0]
    assert float(agreed.spread[0, 1]) == 0.0055
