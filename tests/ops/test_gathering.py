"""Gathering and its reverse against loops over rows; gradients against finite differences."""

import math
import re
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck, gradgradcheck

from pnet.ops.gathering import gather_max, gather_rows, gather_sum, scatter_sum
from pnet.ops.operators import OPERATORS, plain_operators

DIGITS = {torch.float32: 1e-6, torch.float64: 1e-12}


def drawn(B: int, n: int, M: int, k: int, C: int, seed: int = 0, dtype: torch.dtype = torch.float64):
    """Distinct rows (B, n, C), a table into them and weights (B, M, k)."""
    g = torch.Generator().manual_seed(seed)
    rows = torch.randperm(B * n * C, generator=g).view(B, n, C).to(dtype) / (B * n * C) - 0.5
    return rows, torch.randint(0, n, (B, M, k), generator=g), torch.rand(B, M, k, generator=g).to(dtype)


def gather_naive(rows, index, weight):
    """Sum, maximum and winner, one row of the table at a time."""
    B, M, k = index.shape
    total = rows.new_zeros(B, M, rows.shape[2])
    largest, winner = total.clone(), torch.zeros(total.shape, dtype=torch.int32)
    for b in range(B):
        for i in range(M):
            for j in range(k):
                total[b, i] += rows[b, index[b, i, j]] * weight[b, i, j]
            for c in range(rows.shape[2]):
                values = [float(rows[b, index[b, i, j], c]) for j in range(k)]
                largest[b, i, c] = max(values)
                winner[b, i, c] = int(index[b, i, values.index(max(values))])
    return total, largest, winner


def both(call):
    """By the kernel and by the reference."""
    by_kernel = call()
    with plain_operators():
        return by_kernel, call()


SIZES = st.tuples(
    st.integers(1, 3), st.integers(1, 12), st.integers(1, 9), st.integers(1, 6), st.integers(1, 70)
)


@settings(max_examples=25, deadline=None)
@given(SIZES, st.sampled_from([torch.float32, torch.float64]), st.integers(0, 10_000))
def test_sums_and_maxima_are_those_of_the_naive_loop(sizes, dtype, seed):
    B, n, M, k, C = sizes
    rows, index, weight = drawn(B, n, M, k, min(C, 6), seed, dtype)
    total, largest, winner = gather_naive(rows, index, weight)
    plain = gather_naive(rows, index, torch.ones_like(weight))[0]
    for found in both(lambda: gather_sum(rows, index, weight)):
        torch.testing.assert_close(found, total, rtol=0, atol=10 * DIGITS[dtype])
    for found in both(lambda: gather_sum(rows, index)):
        torch.testing.assert_close(found, plain, rtol=0, atol=10 * DIGITS[dtype])
    for value, who in both(lambda: OPERATORS["gather_max"](rows, index)):
        assert torch.equal(value, largest) and torch.equal(who, winner) and who.dtype == torch.int32


@settings(max_examples=25, deadline=None)
@given(SIZES, st.sampled_from([torch.float32, torch.float64]), st.booleans(), st.integers(0, 10_000))
def test_kernels_and_references_have_the_same_values_and_gradients(sizes, dtype, weighted, seed):
    rows, index, weight = drawn(*sizes, seed, dtype)
    weight = weight if weighted else None
    for call in (
        lambda r: gather_sum(r, index, weight),
        lambda r: gather_max(r, index),
        lambda r: gather_rows(r, index),
    ):

        def run(call=call):
            given_rows = rows.clone().requires_grad_()
            taken = call(given_rows)
            taken.backward(torch.linspace(-1, 1, taken.numel(), dtype=dtype).view_as(taken))
            return taken.detach(), given_rows.grad

        (value, grad), (value_plain, grad_plain) = both(run)
        assert value.dtype == grad.dtype == dtype
        torch.testing.assert_close(value, value_plain, rtol=0, atol=DIGITS[dtype])
        torch.testing.assert_close(grad, grad_plain, rtol=DIGITS[dtype], atol=5 * DIGITS[dtype])


def test_rows_keep_the_shape_of_their_table():
    rows = torch.arange(24.0).view(2, 4, 3)
    index = torch.tensor([[[3, 0], [1, 1]], [[2, 2], [0, 3]]])
    taken = gather_rows(rows, index)
    assert taken.shape == (2, 2, 2, 3)
    for b, i, j in [(0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 1)]:
        assert torch.equal(taken[b, i, j], rows[b, index[b, i, j]])
    assert gather_rows(rows, index[:, :, 0]).shape == (2, 2, 3)
    assert gather_rows(rows, index[:, :0, 0]).shape == (2, 0, 3)


def test_sums_and_maxima_by_hand():
    rows = torch.tensor([[[1.0, -1], [2, 0], [4, -5]]])
    index = torch.tensor([[[0, 2], [1, 1]]])
    weight = torch.tensor([[[0.5, 0.25], [2.0, 1.0]]])
    assert gather_sum(rows, index).tolist() == [[[5, -6], [4, 0]]]
    assert gather_sum(rows, index, weight).tolist() == [[[1.5, -1.75], [6, 0]]]
    assert gather_max(rows, index).tolist() == [[[4, -1], [2, 0]]]


def test_scattering_adds_up_what_meets_in_a_row():
    rows = torch.tensor([[[1.0, 10], [2, 20]]])
    index, weight = torch.tensor([[[0, 2], [2, 2]]]), torch.tensor([[[0.5, 1.0], [3.0, 1.0]]])
    for found in both(lambda: OPERATORS["scatter_sum"](rows, index, None, 4)):
        assert found.tolist() == [[[1, 10], [0, 0], [5, 50], [0, 0]]]
    for found in both(lambda: OPERATORS["scatter_sum"](rows, index, weight, 4)):
        assert found.tolist() == [[[0.5, 5], [0, 0], [9, 90], [0, 0]]]
    winner, index = torch.tensor([[[3, 0], [3, 1]]], dtype=torch.int32), torch.tensor([[[0, 3], [1, 3]]])
    for found in both(lambda: OPERATORS["scatter_max"](rows, winner, index, 4)):
        assert found.tolist() == [[[0, 10], [0, 20], [0, 0], [3, 0]]]


@settings(max_examples=20, deadline=None)
@given(SIZES, st.integers(0, 10_000))
def test_scattering_is_the_transpose_of_gathering(sizes, seed):
    rows, index, weight = drawn(*sizes, seed)
    out = torch.randn(*index.shape[:2], rows.shape[2], dtype=torch.float64)
    back = OPERATORS["scatter_sum"](out, index, weight, rows.shape[1])
    torch.testing.assert_close(
        (gather_sum(rows, index, weight) * out).sum(), (rows * back).sum(), rtol=1e-9, atol=1e-9
    )


def test_the_gradient_of_a_maximum_goes_to_the_first_winner_of_the_table():
    rows = torch.tensor([[[1.0, 5], [1, 5], [0, 5]]])
    index = torch.tensor([[[2, 1, 0, 1]]])
    for value, winner in both(lambda: OPERATORS["gather_max"](rows, index)):
        assert value.tolist() == [[[1, 5]]] and winner.tolist() == [[[1, 2]]]

    def grad():
        given_rows = rows.clone().requires_grad_()
        gather_max(given_rows, index).sum().backward()
        return given_rows.grad

    for found in both(grad):
        assert found.tolist() == [[[0, 0], [1, 0], [0, 1]]]


@pytest.mark.parametrize("where", [0, 1, 2])
def test_a_gathered_nan_comes_out(where):
    rows = torch.tensor([[[1.0, 2], [3, 4], [5, 6]]])
    rows[0, where, 0] = math.nan
    index = torch.tensor([[[0, 1, 2], [2, 1, 0], [where, where, where]]])
    for value, winner in both(lambda: OPERATORS["gather_max"](rows, index)):
        assert bool(value[..., 0].isnan().all()) and value[0, :, 1].tolist() == [6, 6, rows[0, where, 1]]
        assert winner[0, :, 0].tolist() == [where] * 3
    for found in both(lambda: gather_sum(rows, index)):
        assert bool(found[..., 0].isnan().all()) and not bool(found[..., 1].isnan().any())
    others = torch.tensor([[[i for i in range(3) if i != where]]])
    for found in both(lambda: gather_max(rows, others)):
        assert not bool(found.isnan().any())


def test_the_first_of_several_nans_wins():
    rows = torch.tensor([[[math.nan], [7.0], [math.nan]]])
    for _, winner in both(lambda: OPERATORS["gather_max"](rows, torch.tensor([[[1, 2, 0]]]))):
        assert winner.tolist() == [[[2]]]


def test_infinities_are_ordinary_values():
    rows = torch.tensor([[[-math.inf, 1], [math.inf, -math.inf]]])
    for found in both(lambda: gather_max(rows, torch.tensor([[[0, 1], [0, 0]]]))):
        assert found.tolist() == [[[math.inf, 1], [-math.inf, 1]]]


@pytest.mark.parametrize("dtype, digits", [(torch.bfloat16, 2**-8), (torch.float16, 2**-11)])
def test_short_floats_keep_their_type_and_are_summed_in_float32(dtype, digits):
    rows, index, weight = drawn(2, 30, 40, 8, 33, dtype=torch.float32)
    short = rows.to(dtype)
    for call in (
        lambda r: gather_sum(r, index),
        lambda r: gather_sum(r, index, weight),
        lambda r: gather_max(r, index),
    ):
        given_rows, full = short.clone().requires_grad_(), short.float().requires_grad_()
        taken, expected = call(given_rows), call(full)
        assert taken.dtype == dtype
        torch.testing.assert_close(taken.float(), expected, rtol=digits, atol=1e-6)
        taken.backward(torch.ones_like(taken))
        expected.backward(torch.ones_like(expected))
        assert given_rows.grad.dtype == dtype
        torch.testing.assert_close(given_rows.grad.float(), full.grad, rtol=digits, atol=1e-6)
        with plain_operators():
            assert call(short).dtype == dtype
    assert gather_rows(short, index).dtype == dtype


def test_weights_of_another_precision_fit():
    rows, index, weight = drawn(2, 9, 7, 3, 4)
    for found in both(lambda: gather_sum(rows.float(), index, weight)):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found, gather_sum(rows, index, weight).float(), rtol=0, atol=1e-6)


def test_weights_get_no_gradient():
    rows, index, weight = drawn(1, 5, 4, 3, 2)
    weight.requires_grad_()
    assert not gather_sum(rows, index, weight).requires_grad
    gather_sum(rows.requires_grad_(), index, weight).sum().backward()
    assert weight.grad is None and rows.grad is not None


CALLS = {
    "sum": lambda index, weight: lambda rows: gather_sum(rows, index),
    "weighted sum": lambda index, weight: lambda rows: gather_sum(rows, index, weight),
    "rows": lambda index, weight: lambda rows: gather_rows(rows, index),
    "maximum": lambda index, weight: lambda rows: gather_max(rows, index),
    "scattered": lambda index, weight: lambda rows: OPERATORS["scatter_sum"](rows[:, :4], index, weight, 6),
}


@pytest.mark.parametrize("call", CALLS)
def test_gradients_are_those_of_finite_differences(call):
    rows, index, weight = drawn(2, 6, 4, 3, 2)
    rows.requires_grad_()
    function = CALLS[call](index, weight)
    assert gradcheck(function, rows)
    with plain_operators():
        assert gradcheck(function, rows)


@pytest.mark.parametrize("call", ["sum", "weighted sum", "rows", "scattered"])
def test_linear_operators_have_second_gradients(call):
    rows, index, weight = drawn(2, 6, 4, 3, 2)
    rows.requires_grad_()
    function = CALLS[call](index, weight)
    assert gradgradcheck(lambda r: function(r).square(), rows)
    with plain_operators():
        assert gradgradcheck(lambda r: function(r).square(), rows)


def test_a_maximum_has_no_second_gradient_and_says_so():
    rows, index, _ = drawn(1, 5, 4, 3, 2)
    rows.requires_grad_()
    (grad,) = torch.autograd.grad(gather_max(rows, index).square().sum(), rows, create_graph=True)
    with pytest.raises(RuntimeError):
        grad.sum().backward()


def test_every_cloud_of_a_batch_has_its_own_rows():
    rows, index, weight = drawn(3, 20, 15, 4, 6)
    for call in (gather_sum, lambda r, i, w: gather_max(r, i)):
        alone = [call(rows[b : b + 1], index[b : b + 1], weight[b : b + 1]) for b in range(3)]
        assert torch.equal(call(rows, index, weight), torch.cat(alone))


@pytest.mark.parametrize("bad", [4, -1, 10**9])
@pytest.mark.parametrize("gather", [gather_rows, gather_sum, gather_max])
def test_a_table_of_another_cloud_is_refused(gather, bad):
    with pytest.raises(IndexError, match="into 4 rows: a table of another cloud"):
        gather(torch.rand(1, 4, 2), torch.tensor([[[0, bad]]]))


@pytest.mark.parametrize("shape", [(2, 3, 1), (1, 3, 0)])
@pytest.mark.parametrize("gather", [gather_sum, gather_max])
def test_a_table_of_another_shape_is_refused(gather, shape):
    with pytest.raises(
        ValueError, match=rf"a table of shape {re.escape(str(shape))} does not fit rows \(1, 4, 2\)"
    ):
        gather(torch.rand(1, 4, 2), torch.zeros(shape, dtype=torch.int64))


def test_a_table_of_more_rows_than_are_sent_is_refused():
    table = torch.zeros(1, 5, 1, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"a table of shape \(1, 5, 1\) does not fit rows \(1, 4, 2\)"):
        scatter_sum(torch.rand(1, 4, 2), table, 3)


def test_weights_of_another_table_are_refused():
    table, message = torch.zeros(1, 5, 2, dtype=torch.int64), r"weights \(1, 5, 1\) do not fit .* \(1, 5, 2\)"
    with pytest.raises(ValueError, match=message):
        gather_sum(torch.rand(1, 4, 2), table, torch.rand(1, 5, 1))
    with pytest.raises(ValueError, match=message):
        scatter_sum(torch.rand(1, 5, 2), table, 4, torch.rand(1, 5, 1))


@pytest.mark.parametrize("winner", [4, -1])
def test_nothing_is_written_outside(winner):
    table = torch.full((1, 1, 1), winner)
    with pytest.raises(IndexError, match="into 4 rows"):
        OPERATORS["scatter_max"](torch.ones(1, 1, 1), table.int(), table, 4)
    with pytest.raises(IndexError, match="into 4 rows"):
        OPERATORS["scatter_sum"](torch.ones(1, 1, 1), table, None, 4)


@pytest.mark.parametrize("plain", [False, True])
def test_short_numbers_are_added_up_in_float32(plain):
    rows, index = (
        torch.full((1, 400, 1), 1.0, dtype=torch.bfloat16),
        torch.zeros(1, 400, 1, dtype=torch.int64),
    )
    with plain_operators() if plain else nullcontext():
        spread = OPERATORS["scatter_sum"](rows, index, None, 2)
        # one by one in bfloat16 the sum would stop at 256
        assert spread.flatten().tolist() == [400, 0] and spread.dtype == torch.bfloat16
        assert OPERATORS["scatter_max"](rows, index.int(), index, 2).flatten().tolist() == [400, 0]
