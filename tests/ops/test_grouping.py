"""The largest row of each group against loops and a counting table; gradients against finite differences."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from pnet.ops.gathering import gather_max
from pnet.ops.grouping import group_max
from pnet.ops.operators import OPERATORS, plain_operators


def both(call):
    """By the kernel and by the reference."""
    by_kernel = call()
    with plain_operators():
        return by_kernel, call()


SIZES = st.tuples(st.integers(1, 3), st.integers(1, 9), st.integers(1, 6), st.integers(1, 70))


@settings(max_examples=25, deadline=None)
@given(SIZES, st.sampled_from([torch.float32, torch.float64]), st.booleans(), st.integers(0, 10_000))
def test_maxima_and_gradients_are_those_of_a_counting_table(sizes, dtype, ties, seed):
    B, m, k, c = sizes
    g = torch.Generator().manual_seed(seed)
    rows = torch.randn(sizes, generator=g).to(dtype)
    rows, grad = rows.round() if ties else rows, torch.randn(B, m, c, generator=g).to(dtype)
    count = torch.arange(m * k).view(1, m, k).expand(B, -1, -1)

    def run(call):
        learned = rows.clone().requires_grad_()
        value = call(learned)
        value.backward(grad)
        return value.detach(), learned.grad

    expected = run(lambda r: gather_max(r.flatten(1, 2), count))
    for found in both(lambda: run(group_max)):
        assert all(torch.equal(a, b) and a.dtype == dtype for a, b in zip(found, expected, strict=True))


def test_maxima_and_winners_by_hand():
    rows = torch.tensor([[[[1.0, -1], [2, 0], [2, -5]], [[0, 3], [-1, 3], [0, 4]]]])
    for value, winner in both(lambda: OPERATORS["group_max"](rows)):
        assert value.tolist() == [[[2, 0], [0, 4]]]
        assert winner.tolist() == [[[1, 1], [0, 2]]] and winner.dtype == torch.int32
    grad = torch.tensor([[[1.0, 2], [3, 4]]])
    for found in both(lambda: OPERATORS["ungroup_max"](grad, winner, 3)):
        assert found.tolist() == [[[[0, 0], [1, 2], [0, 0]], [[3, 0], [0, 0], [0, 4]]]]


@pytest.mark.parametrize("where", [0, 1, 2])
def test_what_is_not_a_number_comes_out(where):
    rows = torch.tensor([[[[1.0, 2], [3, 4], [5, 6]]]])
    rows[0, 0, where, 0] = math.nan
    for value, winner in both(lambda: OPERATORS["group_max"](rows)):
        assert math.isnan(value[0, 0, 0]) and value[0, 0, 1] == 6
        assert winner.tolist() == [[[where, 2]]]
    rows[0, 0, :, 0] = math.nan
    for _, winner in both(lambda: OPERATORS["group_max"](rows)):
        assert winner.tolist() == [[[0, 2]]]


def test_infinities_are_ordinary_values():
    inf = math.inf
    rows = torch.tensor([[[[-inf, 1.0, -inf], [-inf, -inf, 5]]]])
    for value, winner in both(lambda: OPERATORS["group_max"](rows)):
        assert value.tolist() == [[[-inf, 1, 5]]] and winner.tolist() == [[[0, 0, 1]]]


def test_a_gradient_that_is_not_a_number_stays_with_its_winner():
    grad, winner = torch.tensor([[[math.nan, math.inf]]]), torch.tensor([[[1, 0]]], dtype=torch.int32)
    for found in both(lambda: OPERATORS["ungroup_max"](grad, winner, 3)):
        assert found[0, 0, :, 0].isnan().tolist() == [False, True, False]
        assert found[0, 0, :, 1].tolist() == [math.inf, 0, 0]


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_short_floats_keep_their_type_and_their_value(dtype):
    short = torch.randn(2, 30, 8, 33, generator=torch.Generator().manual_seed(0)).to(dtype)

    def run():
        rows = short.clone().requires_grad_()
        value = group_max(rows)
        value.backward(value.detach())
        return value, rows.grad

    for value, grad in both(run):
        assert value.dtype == grad.dtype == dtype and torch.equal(value, short.amax(2))
        assert torch.equal(grad.sum(2), value)


def test_gradients_are_those_of_finite_differences():
    g = torch.Generator().manual_seed(0)
    rows = torch.randperm(2 * 4 * 3 * 2, generator=g).view(2, 4, 3, 2).double().requires_grad_()
    assert gradcheck(group_max, rows)
    with plain_operators():
        assert gradcheck(group_max, rows)


def test_a_maximum_has_no_second_gradient_and_says_so():
    rows = torch.rand(1, 5, 4, 3, dtype=torch.float64, requires_grad=True)
    (grad,) = torch.autograd.grad(group_max(rows).square().sum(), rows, create_graph=True)
    with pytest.raises(RuntimeError):
        grad.sum().backward()


def test_no_groups_have_no_maxima():
    for shape in [(2, 0, 3, 4), (0, 5, 3, 4), (2, 5, 3, 0)]:
        rows = torch.zeros(shape, requires_grad=True)
        value = group_max(rows)
        assert value.shape == (shape[0], shape[1], shape[3])
        value.sum().backward()
        assert rows.grad.shape == shape


def test_a_group_without_rows_is_refused():
    with pytest.raises(ValueError, match=r"groups of shape \(2, 3, 0, 4\) have no rows"):
        group_max(torch.zeros(2, 3, 0, 4))


def test_winners_of_another_gradient_are_refused():
    winner = torch.zeros(1, 5, 3, dtype=torch.int32)
    with pytest.raises(ValueError, match=r"winners \(1, 5, 3\) do not fit a gradient \(1, 4, 3\)"):
        OPERATORS["ungroup_max"](torch.rand(1, 4, 3), winner, 2)
    with pytest.raises(ValueError, match=r"winners \(1, 5, 3\) do not fit a gradient \(1, 4, 3\)"):
        OPERATORS["scatter_max"](torch.rand(1, 4, 3), winner, winner.long(), 2)
