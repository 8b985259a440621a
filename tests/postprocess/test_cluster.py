"""Mean shift on hand-made blobs."""

import pytest
import torch

from pnet.postprocess.cluster import CentroidClusters, drop_small

CLUSTER = CentroidClusters(bandwidth=0.006, min_seed_points=5, min_points=10)


def blobs(sizes: list[int], gap: float = 0.03, spread: float = 0.0005) -> tuple[torch.Tensor, torch.Tensor]:
    """Gaussian blobs in a row, and whose point is whose."""
    torch.manual_seed(0)
    owner = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    middle = torch.stack([gap * owner, torch.zeros(len(owner)), torch.full((len(owner),), 0.6)], -1)
    return middle + spread * torch.randn(len(owner), 3), owner


@pytest.mark.parametrize("sizes", [[50], [50, 60], [30, 200, 50, 90, 20]])
def test_separate_blobs_are_one_cluster_each(sizes):
    centroids, owner = blobs(sizes)
    labels = CLUSTER(centroids)
    assert labels.dtype == torch.int64 and int(labels.max()) + 1 == len(sizes)
    pairs = {(int(a), int(b)) for a, b in zip(owner, labels, strict=True)}
    assert len(pairs) == len(sizes)  # one to one, and nothing is −1


def test_points_far_from_every_cluster_are_noise():
    centroids, _ = blobs([50, 50])
    labels = CLUSTER(torch.cat([centroids, torch.tensor([[0.5, 0.5, 0.5], [-0.5, 0, 0.6]])]))
    assert labels[-2:].tolist() == [-1, -1] and bool((labels[:-2] >= 0).all())


def test_blobs_nearer_than_the_bandwidth_are_one():
    centroids, _ = blobs([50, 50], gap=0.003)
    assert int(CLUSTER(centroids).max()) == 0


def test_a_blob_of_too_few_points_is_left_out():
    centroids, owner = blobs([50, 9, 40])
    labels = CLUSTER(centroids)
    assert set(labels[owner == 1].tolist()) == {-1}
    assert set(labels.tolist()) == {-1, 0, 1}


def test_where_nothing_is_dense_there_is_no_cluster():
    lonely = torch.arange(30.0)[:, None] * torch.ones(3)
    assert CLUSTER(lonely).tolist() == [-1] * 30


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_centroids_that_are_no_numbers_give_no_cluster(value):
    centroids, _ = blobs([50])
    centroids[7, 1] = value
    assert CLUSTER(centroids).tolist() == [-1] * 50


def test_no_points_give_no_labels():
    labels = CLUSTER(torch.zeros(0, 3))
    assert labels.shape == (0,) and labels.dtype == torch.int64


def test_drop_small_renumbers_without_gaps():
    labels = torch.tensor([2, 0, 2, 1, -1, 2, 3, 3, 0])
    assert drop_small(labels, 2).tolist() == [1, 0, 1, -1, -1, 1, 2, 2, 0]
    assert drop_small(labels, 1).tolist() == labels.tolist()
    assert drop_small(labels, 4).tolist() == [-1] * 9
    assert drop_small(torch.tensor([-1, -1]), 1).tolist() == [-1, -1]
