"""Points by their cluster: by hand and against one cluster at a time."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.postprocess.grouping import cluster_sizes, clusters_of


def test_clusters_by_hand():
    """Two clusters in the first scene, none in the second, one in the third."""
    owner = torch.tensor([[1, -1, 0, 1], [-1] * 4, [2, 2, -1, 2]])
    clusters = clusters_of(owner)
    assert clusters.member.tolist() == [2, 0, 3, 8, 9, 11]
    assert clusters.groups.owner.tolist() == [0, 1, 1, 2, 2, 2]
    assert clusters.groups.size.tolist() == [1, 2, 3] and clusters.groups.largest == 3
    assert clusters.scenes == [2, 0, 1] and len(clusters.groups) == 3
    assert clusters.of(torch.arange(12).view(3, 4) * 10).tolist() == [20, 0, 30, 80, 90, 110]
    assert clusters.of(torch.arange(36).view(3, 4, 3))[0].tolist() == [6, 7, 8]


@pytest.mark.parametrize("shape", [(0, 4), (3, 0), (2, 5)])
def test_without_clusters_there_is_no_member(shape):
    clusters = clusters_of(torch.full(shape, -1))
    assert clusters.member.shape == clusters.groups.owner.shape == clusters.groups.size.shape == (0,)
    assert clusters.scenes == [0] * shape[0] and clusters.groups.largest == len(clusters.groups) == 0


def test_the_first_rows_by_hand():
    groups = clusters_of(torch.tensor([[1, -1, 0, 1, 1, 2, -1, 1, 0]])).groups
    index, valid = groups.first(3)
    assert index.tolist() == [[0, 1, 0], [2, 3, 4], [6, 6, 6]]
    assert valid.tolist() == [[True, True, False], [True] * 3, [True, False, False]]
    assert groups.first(1)[0].tolist() == [[0], [2], [6]]
    assert groups.first(50)[0].shape == (3, 4)  # no wider than the largest


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), d=st.integers(1, 5), most=st.integers(1, 12))
def test_against_one_cluster_at_a_time(seed, d, most):
    generator = torch.Generator().manual_seed(seed)
    first = torch.cat([torch.arange(d), torch.randint(-1, d, (30,), generator=generator)])
    owner = torch.stack([first, torch.where(first >= 0, first + d, -1).roll(3)])
    clusters = clusters_of(owner)
    index, valid = clusters.groups.first(most)
    assert clusters.scenes == [d, d] and torch.equal(cluster_sizes(owner, 2 * d), clusters.groups.size)
    for c in range(2 * d):
        own = torch.nonzero(owner.flatten() == c).squeeze(1).tolist()
        assert clusters.member[clusters.groups.owner == c].tolist() == own
        assert clusters.member[index[c, valid[c]]].tolist() == own[:most]
        assert set(clusters.member[index[c, ~valid[c]]].tolist()) <= {own[0]}
