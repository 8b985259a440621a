"""Mean shift on hand-made blobs."""

import pytest
import torch

from pnet.postprocess.cluster import CentroidClusters, drop_small
from pnet.postprocess.kernels import Kernels, only

CLUSTER = CentroidClusters(bandwidth=0.006, min_seed_points=5, min_points=10)


def cluster(centroids: torch.Tensor) -> torch.Tensor:
    """(N,) labels of one scene (N, 3)."""
    return CLUSTER(centroids[None])[0]


def blobs(sizes: list[int], gap: float = 0.03, spread: float = 0.0005) -> tuple[torch.Tensor, torch.Tensor]:
    """Gaussian blobs in a row, and whose point is whose."""
    torch.manual_seed(0)
    owner = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    middle = torch.stack([gap * owner, torch.zeros(len(owner)), torch.full((len(owner),), 0.6)], -1)
    return middle + spread * torch.randn(len(owner), 3), owner


@pytest.mark.parametrize("sizes", [[50], [50, 60], [30, 200, 50, 90, 20]])
def test_separate_blobs_are_one_cluster_each(sizes):
    centroids, owner = blobs(sizes)
    labels = cluster(centroids)
    assert labels.dtype == torch.int64 and int(labels.max()) + 1 == len(sizes)
    pairs = {(int(a), int(b)) for a, b in zip(owner, labels, strict=True)}
    assert len(pairs) == len(sizes)  # one to one, and nothing is −1


def test_points_far_from_every_cluster_are_noise():
    centroids, _ = blobs([50, 50])
    labels = cluster(torch.cat([centroids, torch.tensor([[0.5, 0.5, 0.5], [-0.5, 0, 0.6]])]))
    assert labels[-2:].tolist() == [-1, -1] and bool((labels[:-2] >= 0).all())


def test_blobs_nearer_than_the_bandwidth_are_one():
    centroids, _ = blobs([50, 50], gap=0.003)
    assert int(cluster(centroids).max()) == 0


def test_a_blob_of_too_few_points_is_left_out():
    centroids, owner = blobs([50, 9, 40])
    labels = cluster(centroids)
    assert set(labels[owner == 1].tolist()) == {-1}
    assert set(labels.tolist()) == {-1, 0, 1}


def test_where_nothing_is_dense_there_is_no_cluster():
    lonely = torch.arange(30.0)[:, None] * torch.ones(3)
    assert cluster(lonely).tolist() == [-1] * 30


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_centroids_that_are_no_numbers_give_no_cluster(value):
    centroids, _ = blobs([50])
    centroids[7, 1] = value
    assert cluster(centroids).tolist() == [-1] * 50


def test_no_points_give_no_labels():
    labels = cluster(torch.zeros(0, 3))
    assert labels.shape == (0,) and labels.dtype == torch.int64


def test_drop_small_renumbers_without_gaps():
    labels = torch.tensor([2, 0, 2, 1, -1, 2, 3, 3, 0])
    assert drop_small(labels, 4, 2).tolist() == [1, 0, 1, -1, -1, 1, 2, 2, 0]
    assert drop_small(labels, 4, 1).tolist() == labels.tolist()
    assert drop_small(labels, 4, 4).tolist() == [-1] * 9
    assert drop_small(torch.tensor([-1, -1]), 0, 1).tolist() == [-1, -1]


def test_clusters_without_a_point_are_left_out_even_if_small_ones_may_stay():
    assert drop_small(torch.tensor([[3, 1], [-1, 3]]), 5, 0).tolist() == [[1, 0], [-1, 1]]


@pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
def test_scenes_are_clustered_by_themselves_and_numbered_through(kernels):
    """Two scenes in the very same place, between them one of noise and one that is no number."""
    first, _ = blobs([50, 60, 30])
    second, _ = blobs([90, 50])
    nothing, wrong = torch.arange(140.0)[:, None] * torch.ones(3), first.clone()
    wrong[5, 2] = float("nan")
    with only(kernels):
        labels = CLUSTER(torch.stack([first, nothing, wrong, second]))
    assert torch.equal(labels[0], cluster(first))
    assert labels[1:3].tolist() == [[-1] * 140] * 2
    assert torch.equal(labels[3], cluster(second) + 3)


@pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
def test_points_that_do_not_count_are_not_there(kernels):
    """Half of blob 1 and all of blob 2 do not count, nor does one that is no number."""
    centroids, owner = blobs([50, 60, 30])
    counted = (owner == 0) | ((owner == 1) & (torch.arange(140) % 2 == 0))
    centroids[-1] = float("inf")
    both = torch.stack([centroids, centroids])
    with only(kernels):
        labels = CLUSTER(both, torch.stack([counted, torch.zeros_like(counted)]))
    expected = torch.full((140,), -1)
    expected[counted] = cluster(centroids[counted])
    assert labels[0].tolist() == expected.tolist() and int(expected.max()) == 1
    assert labels[1].tolist() == [-1] * 140
