"""Gathering and its reverse: kernels against the references, on odd sizes and tails."""

import pytest
import torch

from pnet.ops.cuda import gathering as kernels
from pnet.ops.gathering import gather_sum
from pnet.ops.operators import plain_operators

# clouds, rows, places, neighbours, channels
SHAPES = [(1, 1, 1, 1, 1), (2, 9, 7, 4, 5), (3, 40, 33, 3, 65), (1, 5, 17, 8, 130), (2, 6, 0, 3, 4)]


def case(shape, dtype):
    B, n, m, k, c = shape
    g = torch.Generator().manual_seed(0)
    rows = torch.randn(B, n, c, generator=g).to(dtype)
    index = torch.randint(0, n, (B, m, k), generator=g)
    return rows, index, torch.rand(B, m, k, generator=g)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_gathered_sums_are_the_references(here, shape, dtype, weighted):
    rows, index, weight = case(shape, dtype)
    weight = weight.to(torch.float64 if dtype == torch.float64 else torch.float32) if weighted else None
    with plain_operators():
        expected = gather_sum(rows, index, weight)
    found = kernels.gather_sum(here(rows), here(index), here(weight)).cpu()
    torch.testing.assert_close(found, expected)


def test_a_place_outside_the_rows_is_seen_and_nothing_else_is_read(here):
    rows = torch.arange(6.0).view(1, 3, 2)
    found = kernels.gather_sum(here(rows), here(torch.tensor([[[0, 1], [2, 3], [-1, 0]]])), None).cpu()
    assert found[0, 0].tolist() == [2.0, 4.0]
    assert found[0, 1:].isnan().all()
