"""Gathering: kernels against the references, on odd sizes and tails."""

import math

import pytest
import torch

from pnet.ops.cuda import gathering as kernels
from pnet.ops.gathering import gather_sum
from pnet.ops.operators import OPERATORS, plain_operators

# clouds, rows, places, neighbours, channels
SHAPES = [(1, 1, 1, 1, 1), (2, 9, 7, 4, 5), (2, 40, 18, 3, 65), (1, 5, 17, 8, 130), (2, 6, 0, 3, 4)]
DTYPES = [torch.float32, torch.float64, torch.bfloat16]


def case(shape, dtype):
    B, n, m, k, c = shape
    g = torch.Generator().manual_seed(0)
    rows = torch.randn(B, n, c, generator=g).to(dtype)
    index = torch.randint(0, n, (B, m, k), generator=g)
    return rows, index, torch.rand(B, m, k, generator=g)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_gathered_sums_are_the_references(here, shape, dtype, weighted):
    rows, index, weight = case(shape, dtype)
    weight = weight.to(torch.float64 if dtype == torch.float64 else torch.float32) if weighted else None
    with plain_operators():
        expected = gather_sum(rows, index, weight)
    found = kernels.gather_sum(here(rows), here(index), here(weight)).cpu()
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("kind", ["all different", "ties", "not a number", "infinite"])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_maxima_and_winners_are_the_references(here, shape, dtype, kind):
    rows, index, _ = case(shape, dtype)
    if kind == "ties":
        rows = rows.round()
    elif kind != "all different":
        few = torch.rand(rows.shape, generator=torch.Generator().manual_seed(1)) < 0.3
        rows[few] = math.nan if kind == "not a number" else -math.inf
    with plain_operators():
        largest, winner = OPERATORS["gather_max"](rows, index)
    found, who = (t.cpu() for t in kernels.gather_max(here(rows), here(index)))
    torch.testing.assert_close(found, largest, rtol=0, atol=0, equal_nan=True)
    assert who.dtype == torch.int32 and torch.equal(who, winner)


def test_the_first_of_equal_rows_wins_and_the_first_that_is_not_a_number(here):
    nan, inf = math.nan, math.inf
    rows = torch.tensor([[[1.0, -inf, nan], [2.0, -inf, 7.0], [2.0, -inf, nan], [1.0, -inf, inf]]])
    index = torch.tensor([[[3, 2, 1, 1], [3, 0, 3, 0], [1, 3, 2, 0]]])
    largest, winner = (t.cpu() for t in kernels.gather_max(here(rows), here(index)))
    assert largest[0, :, :2].tolist() == [[2, -inf], [1, -inf], [2, -inf]]
    assert largest[0, :, 2].isnan().all()
    assert winner.tolist() == [[[2, 3, 2], [3, 3, 0], [1, 1, 2]]]


def test_a_place_outside_the_rows_is_seen_and_nothing_else_is_read(here):
    rows = torch.arange(6.0).view(1, 3, 2)
    index = torch.tensor([[[0, 1], [2, 3], [-1, 0], [1, 2**32]]])
    total = kernels.gather_sum(here(rows), here(index), None).cpu()
    assert total[0, 0].tolist() == [2.0, 4.0] and total[0, 1:].isnan().all()
    largest, _ = kernels.gather_max(here(rows), here(index))
    assert largest[0, 0].tolist() == [2.0, 3.0] and largest[0, 1:].isnan().all()


def test_how_the_rows_and_the_table_lie_in_memory_does_not_matter(here):
    rows, index, weight = (here(t) for t in case((3, 9, 7, 4, 5), torch.float32))
    apart = rows.mT.contiguous().mT, index.mT.contiguous().mT, weight.mT.contiguous().mT
    assert not any(t.is_contiguous() for t in apart)
    assert torch.equal(kernels.gather_sum(*apart), kernels.gather_sum(rows, index, weight))
    for found, expected in zip(kernels.gather_max(*apart[:2]), kernels.gather_max(rows, index), strict=True):
        assert torch.equal(found, expected)


@pytest.mark.parametrize("shape", [(2, 3, 1), (1, 3, 0)])
def test_a_table_of_another_shape_is_refused(here, shape):
    rows, index = here(torch.rand(1, 4, 2)), here(torch.zeros(shape, dtype=torch.int64))
    for call in (lambda: kernels.gather_sum(rows, index, None), lambda: kernels.gather_max(rows, index)):
        with pytest.raises(ValueError, match="does not fit rows"):
            call()
