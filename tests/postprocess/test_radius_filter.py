"""The radius filter against a double loop."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pnet.postprocess.grouping import clusters_of
from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.radius_filter import RadiusFilter

BOTH = pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
RF = RadiusFilter(radius=0.01, neighbours=3, widen=0.002, max_radius=0.02, enough=0.1)


def filtered(rf: RadiusFilter, votes: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """(N,) bool of votes (N, 3) in any order, labels (N,); no number may be left out."""
    clusters = clusters_of(labels[None])
    kept = torch.zeros(len(labels), dtype=torch.bool)
    kept[clusters.member] = rf(clusters.of(votes[None])[:, None], clusters.groups)[:, 0]
    return kept


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


@BOTH
@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 40),
    d=st.integers(1, 4),
    neighbours=st.integers(0, 6),
    enough=st.sampled_from([0.1, 0.4, 0.9]),
)
def test_it_is_the_naive_loop_and_never_loses_a_cluster(kernels, seed, n, d, neighbours, enough):
    generator = torch.Generator().manual_seed(seed)
    votes = 0.03 * torch.rand(n, 3, generator=generator, dtype=torch.float64)
    labels = torch.cat([torch.arange(d), torch.randint(-1, d, (n,), generator=generator)])[:n]
    rf = replace(RF, neighbours=neighbours, enough=enough)
    with only(kernels):
        kept = filtered(rf, votes, labels)
    assert kept.tolist() == naive(rf, votes, labels)
    assert set(labels[kept].tolist()) == set(labels.tolist()) - {-1}


def by_trees(rf: RadiusFilter, votes: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """A k-d tree for each cluster."""
    kept = labels >= 0
    for cluster in range(int(labels.max()) + 1):
        members = torch.nonzero(labels == cluster).squeeze(1)
        places, radius = votes[members].double().numpy(), rf.radius
        while len(members):
            near = cKDTree(places).query_ball_point(places, radius, return_length=True)
            own = torch.from_numpy(near - 1 >= rf.neighbours)
            radius += rf.widen
            if float(own.double().mean()) >= rf.enough:
                break
            if radius > rf.max_radius + 1e-9 or rf.widen <= 0:
                own = own if bool(own.any()) else torch.ones_like(own)
                break
        kept[members] = own if len(members) else kept[members]
    return kept


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("neighbours", [20, 120])
def test_a_full_scene_is_filtered_as_by_one_tree_a_cluster(neighbours, dtype, monkeypatch):
    """Tight, wide and scattered clusters of 20 to 400 votes; any number of threads, or plain torch."""
    generator = torch.Generator().manual_seed(0)
    labels = torch.repeat_interleave(torch.arange(-1, 24), 20 + 15 * torch.arange(25))
    labels = labels[torch.randperm(len(labels), generator=generator)]
    spread = torch.tensor([0.0007, 0.006, 0.012, 0.05])[labels % 4]
    votes = spread[:, None] * torch.randn(len(labels), 3, generator=generator)
    votes = votes.to(dtype)
    rf = replace(RF, neighbours=neighbours)
    expected = by_trees(rf, votes, labels)
    assert 0.2 < float(expected.double().mean()) < 0.95
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert torch.equal(filtered(rf, votes, labels), expected)
    with only(Kernels.PLAIN):
        assert torch.equal(filtered(rf, votes, labels), expected)


@BOTH
def test_every_column_has_its_own_verdict(kernels):
    """Of the second column's ten votes two are far off; in the third all are."""
    votes = torch.zeros(20, 3, 3).double()
    votes[[3, 14], 1] = 1.0
    votes[:, 2] = torch.arange(20.0).double()[:, None]
    clusters = clusters_of(torch.arange(2).repeat_interleave(10)[None])
    with only(kernels):
        kept = RF(votes, clusters.groups)
    assert bool(kept[:, [0, 2]].all()) and (~kept[:, 1]).nonzero().flatten().tolist() == [3, 14]


def row(*x: float) -> torch.Tensor:
    return torch.tensor([[value, 0, 0] for value in x], dtype=torch.float64)


def test_a_vote_that_stands_alone_is_not_counted():
    votes = row(0, 0.001, 0.002, 0.003, 0.1)
    assert filtered(RF, votes, torch.zeros(5).long()).tolist() == [True] * 4 + [False]


def test_votes_of_another_cluster_do_not_help():
    votes = row(0, 0.001, 0.002, 0.003, 0.0015)
    assert (
        filtered(RF, votes, torch.tensor([0, 0, 0, 0, 1])).tolist() == [True] * 5
    )  # alone in its cluster: kept
    labels = torch.tensor([0, 0, 0, 0, -1])
    assert filtered(RF, votes, labels).tolist() == [True] * 4 + [False]


def test_the_radius_widens_until_enough_are_left():
    votes = row(0, 0.013, 0.026, 0.2)
    rf = replace(RF, neighbours=2)
    assert filtered(rf, votes, torch.zeros(4).long()).tolist() == [False, True, False, False]  # at 14 mm
    narrow = replace(rf, max_radius=0.012)
    assert (
        filtered(narrow, votes, torch.zeros(4).long()).tolist() == [True] * 4
    )  # nothing is dense: all count
    # without widening there is one pass
    assert filtered(replace(rf, widen=0.0), votes, torch.zeros(4).long()).tolist() == [True] * 4


def test_the_largest_radius_is_tried_too():
    """0.01 + 5 · 0.002 exceeds 0.02 by a rounding error."""
    votes = row(0, 0.019, 0.038, 0.2)
    assert filtered(replace(RF, neighbours=2), votes, torch.zeros(4).long()).tolist() == [
        False,
        True,
        False,
        False,
    ]


def test_exactly_enough_is_enough():
    votes = row(*[0.0] * 9, 0.015)  # nine of ten; at 16 mm the tenth would be kept as well
    kept = filtered(replace(RF, enough=0.9), votes, torch.zeros(10).long())
    assert kept.tolist() == [True] * 9 + [False]


def test_clusters_without_neighbours_at_all_keep_their_votes():
    votes = row(0, 1, 2)
    assert filtered(RF, votes, torch.zeros(3).long()).all()


@BOTH
@pytest.mark.parametrize("labels", [[], [-1, -1]])
def test_without_clusters_nothing_is_kept(kernels, labels):
    with only(kernels):
        kept = filtered(RF, torch.zeros(len(labels), 3), torch.tensor(labels).long())
    assert kept.tolist() == [False] * len(labels)
