"""Buckets: near points together, each with its tight box, none lost."""

import pytest
import torch

from pnet.ops.cuda.buckets import build_buckets


@pytest.mark.parametrize("size", [1, 8, 64])
def test_every_point_is_in_one_bucket_and_in_its_box(clouds, size):
    B, n, _ = clouds.shape
    place, number, low, high = build_buckets(clouds, size)
    count = low.shape[2]
    assert count & (count - 1) == 0 and n <= count * size < 2 * max(n, size)
    assert place.shape == (B, 3, count * size) and number.dtype == torch.int32
    assert torch.equal(number.sort(1).values, torch.arange(count * size).int().expand(B, -1))
    own = clouds.gather(1, number.long().clamp(max=n - 1)[..., None].expand(-1, -1, 3))
    assert torch.equal(place, own.transpose(1, 2))
    boxes = place.unflatten(2, (count, size))
    assert torch.equal(low, boxes.amin(3)) and torch.equal(high, boxes.amax(3))


def test_buckets_cut_the_longest_side():
    points = torch.rand(2, 4096, 3, generator=torch.Generator().manual_seed(0))
    flat = build_buckets(points * torch.tensor([1, 1, 0.01]), 64)
    side = flat.high - flat.low
    assert float((side[:, 0] * side[:, 1]).mean()) < 1.1 / 64  # of 64 buckets, nearly without overlap
    long = build_buckets(points * torch.tensor([1, 100, 1]), 64)
    assert float((long.high - long.low)[:, 1].mean()) < 1.1 * 100 / 64
