"""Farthest point sampling in buckets: the reference's order, to the last point."""

import pytest
import torch

from pnet.ops.cuda import sampling as kernels
from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_points

SOME = None if torch.cuda.is_available() else 14  # points: the interpreter takes its time


def agree(here, points, count, start):
    """The kernel's order is the reference's."""
    with plain_operators():
        expected = farthest_points(points, count, start)
    found = kernels.farthest_points(here(points), count, start).cpu()
    assert found.dtype == torch.int64 and torch.equal(found, expected)


def random(*shape, seed=0):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed))


def test_the_order_of_small_buckets_is_the_reference_s(here, monkeypatch, clouds):
    monkeypatch.setattr(kernels, "SIZE", 4)
    some = clouds[:, :SOME]
    agree(here, some, some.shape[1] + 3, some.shape[1] // 2)


def test_a_cloud_of_one_bucket_is_sampled(here, clouds):
    agree(here, clouds[:, :7], 5, 0)


@pytest.mark.parametrize("n", [63, 64, 65, 129])
def test_sizes_around_a_block_s_border(here, monkeypatch, n):
    monkeypatch.setattr(kernels, "SIZE", 16)
    agree(here, random(3, n), 6, n - 1)


def test_many_buckets_of_a_surface(here, monkeypatch):
    monkeypatch.setattr(kernels, "SIZE", 8)
    points = random(1, 300)
    points[..., 2] = 0.1 * torch.sin(9 * points[..., 0])
    agree(here, points, 30, 17)


def test_the_buckets_of_a_large_cloud_grow_and_not_their_number(here, monkeypatch):
    for name, value in {"SIZE": 4, "ONE_WARP": 32, "BUCKETS": 8, "MANY_BUCKETS": 4}.items():
        monkeypatch.setattr(kernels, name, value)
    agree(here, random(2, 32), 32, 3)
    agree(here, random(2, 60), 25, 3)


def test_points_too_far_apart_for_a_squared_distance_keep_their_order(here, monkeypatch):
    monkeypatch.setattr(kernels, "SIZE", 2)
    points = random(1, 9)
    points[0, [2, 5, 6]] += torch.tensor([[1e25], [-1e25], [3e25]])
    agree(here, points, 9, 0)
