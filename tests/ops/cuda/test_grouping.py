"""The largest row of each group and its reverse: kernels against the references, on odd sizes and tails."""

import math

import pytest
import torch

from pnet.ops.cuda import grouping as kernels
from pnet.ops.operators import OPERATORS, plain_operators

# clouds, groups, rows of a group, channels
SHAPES = [(1, 1, 1, 1), (2, 9, 7, 5), (3, 11, 3, 65), (1, 17, 8, 130), (2, 0, 3, 4), (2, 3, 4, 0)]
DTYPES = [torch.float32, torch.float64, torch.bfloat16]


def drawn(shape, dtype):
    return torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(dtype)


@pytest.mark.parametrize("kind", ["all different", "ties", "not a number", "infinite"])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_maxima_and_winners_are_the_references(here, shape, dtype, kind):
    rows = drawn(shape, dtype)
    if kind == "ties":
        rows = rows.round()
    elif kind != "all different":
        few = torch.rand(shape, generator=torch.Generator().manual_seed(1)) < 0.4
        rows[few] = math.nan if kind == "not a number" else -math.inf
    with plain_operators():
        largest, winner = OPERATORS["group_max"](rows)
    found, who = (t.cpu() for t in kernels.group_max(here(rows)))
    torch.testing.assert_close(found, largest, rtol=0, atol=0, equal_nan=True)
    assert who.dtype == torch.int32 and torch.equal(who, winner)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_what_winners_get_is_the_references(here, shape, dtype):
    B, m, k, c = shape
    g = torch.Generator().manual_seed(0)
    grad, winner = drawn((B, m, c), dtype), torch.randint(0, k, (B, m, c), generator=g, dtype=torch.int32)
    with plain_operators():
        expected = OPERATORS["ungroup_max"](grad, winner, k)
    found = kernels.ungroup_max(here(grad), here(winner), k).cpu()
    assert found.dtype == dtype and torch.equal(found, expected)


def test_the_gradient_is_that_of_the_first_largest(here):
    rows = drawn((2, 9, 7, 5), torch.float64).round()
    grad = drawn((2, 9, 5), torch.float64)
    plain = rows.clone().requires_grad_()
    plain.gather(2, rows.argmax(2, keepdim=True))[:, :, 0].backward(grad)
    _, winner = kernels.group_max(here(rows))
    assert torch.equal(kernels.ungroup_max(here(grad), winner, 7).cpu(), plain.grad)


def test_a_gradient_that_is_not_a_number_stays_with_its_winner(here):
    grad, winner = torch.tensor([[[math.nan, math.inf]]]), torch.tensor([[[1, 0]]], dtype=torch.int32)
    found = kernels.ungroup_max(here(grad), here(winner), 3).cpu()
    assert found[0, 0, :, 0].isnan().tolist() == [False, True, False]
    assert found[0, 0, :, 1].tolist() == [math.inf, 0, 0]


def test_how_tensors_lie_in_memory_does_not_matter(here):
    rows = here(drawn((2, 9, 7, 5), torch.float32))
    largest, winner = kernels.group_max(rows)
    for found, expected in zip(kernels.group_max(rows.mT.contiguous().mT), (largest, winner), strict=True):
        assert torch.equal(found, expected)
    found = kernels.ungroup_max(largest.mT.contiguous().mT, winner.mT.contiguous().mT, 7)
    assert torch.equal(found, kernels.ungroup_max(largest, winner, 7))


def test_a_group_without_rows_is_refused(here):
    with pytest.raises(ValueError, match=r"groups of shape \(2, 3, 0, 4\) have no rows"):
        kernels.group_max(here(torch.zeros(2, 3, 0, 4)))


def test_winners_of_another_gradient_are_refused(here):
    with pytest.raises(ValueError, match=r"winners \(1, 5, 3\) do not fit a gradient \(1, 4, 3\)"):
        kernels.ungroup_max(here(torch.rand(1, 4, 3)), here(torch.zeros(1, 5, 3, dtype=torch.int32)), 2)
