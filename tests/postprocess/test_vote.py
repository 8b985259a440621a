"""Means and spreads of votes."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from pnet.postprocess.grouping import Groups
from pnet.postprocess.vote import MeanVote, PointVotes, vote, vote_spread


def standing(*size: int) -> Groups:
    """Clusters of these sizes."""
    sizes = torch.tensor(size)
    return Groups(torch.arange(len(size)).repeat_interleave(sizes), sizes, max(size))


GROUPS = standing(2, 3)
KEPT = torch.tensor([True, True, True, False, True])


def test_means_by_hand():
    values = torch.tensor([10.0, 20, 1, 1001, 3])
    assert vote(values, GROUPS, KEPT).tolist() == [15, 2]
    assert vote(values, GROUPS).tolist() == [15, 335]


def test_what_does_not_count_may_be_no_number():
    assert vote(torch.tensor([10.0, 20, 1, torch.nan, 3]), GROUPS, KEPT).tolist() == [15, 2]


def test_values_may_be_points():
    values = torch.arange(15.0).view(5, 3)
    means = vote(values, GROUPS, KEPT)
    torch.testing.assert_close(means, torch.stack([values[[0, 1]].mean(0), values[[2, 4]].mean(0)]))


def test_columns_may_count_by_themselves():
    values = torch.arange(30.0).view(5, 2, 3)
    kept = torch.stack([KEPT, torch.tensor([False, True, True, True, True])], 1)
    means = vote(values, GROUPS, kept)
    assert means.shape == (2, 2, 3)
    assert torch.equal(means[:, 0], vote(values[:, 0], GROUPS, KEPT))
    assert means[:, 1].tolist() == [values[1, 1].tolist(), values[3, 1].tolist()]
    spread = vote_spread(values, GROUPS, means, kept)
    assert torch.equal(spread[:, 0], vote_spread(values[:, 0], GROUPS, means[:, 0], KEPT))
    torch.testing.assert_close(spread[:, 1], torch.tensor([0.0, (2 / 3 * 3 * 36) ** 0.5]))


def test_spread_is_the_root_mean_square_distance():
    values = torch.tensor([[0.0, 1, 0], [0, 1, 0], [3, 0, 0], [9, 9, 9], [-3, 0, 0]])
    means = vote(values, GROUPS, KEPT)
    torch.testing.assert_close(vote_spread(values, GROUPS, means, KEPT), torch.tensor([0.0, 3.0]))


@given(seed=st.integers(0, 10**6), d=st.integers(1, 5))
def test_against_one_cluster_at_a_time(seed, d):
    generator = torch.Generator().manual_seed(seed)
    groups = standing(*torch.randint(1, 12, (d,), generator=generator).tolist())
    kept = torch.rand(len(groups.owner), generator=generator) < 0.7
    kept[groups.size.cumsum(0) - 1] = True
    values = torch.randn(len(groups.owner), 3, generator=generator, dtype=torch.float64)
    means = vote(values, groups, kept)
    spread = vote_spread(values, groups, means, kept)
    for c in range(d):
        own = values[kept & (groups.owner == c)]
        torch.testing.assert_close(means[c], own.mean(0))
        torch.testing.assert_close(spread[c], own.var(0, correction=0).sum().sqrt())


def three_votes_of_two_flanges() -> PointVotes:
    """Base, top and rim at hand; cluster 0 has two points, cluster 1 one."""
    first = torch.tensor([[0.0, 0, -4], [0, 0, 6], [12, 0, -4]], dtype=torch.float64)
    second = torch.tensor([[0.0, 0, -2], [0, 0, 12], [0, 20, -2]], dtype=torch.float64)
    centroid = torch.tensor([[1.0, 0, 0], [3, 0, 0], [0, 7, 0]], dtype=torch.float64)
    reliable = torch.ones(3, 4, dtype=torch.bool)
    return PointVotes(centroid, torch.stack([first, first + 2, second]), standing(2, 1), reliable)


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
    votes.reliable[1, 1:3] = False
    votes.keypoints[1, 2] += torch.tensor([4.0, 0, 0])
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
    reliable = torch.ones(2, 4, dtype=torch.bool)
    agreed = MeanVote()(tn06, PointVotes(torch.zeros(2, 3).double(), keypoints, standing(2), reliable))
    assert agreed.keypoints[0, 0].tolist() == [0, 0, 0]
    assert float(agreed.spread[0, 1]) == 0.0055
