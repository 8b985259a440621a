"""Means and spreads of votes."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from pnet.postprocess.vote import vote, vote_spread

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
