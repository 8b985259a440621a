"""The reverse of gathering: kernels against references, naive loops and autograd, on tables of every kind."""

import numpy as np
import pytest
import torch

from pnet.ops.cuda import gathering, scattering
from pnet.ops.gathering import gather_max, gather_sum, scatter_sum
from pnet.ops.operators import OPERATORS, plain_operators

DTYPES = [torch.float32, torch.float64, torch.bfloat16]


def _random(g, B, n, m, k):
    return torch.randint(0, n, (B, m, k), generator=g)


def _one_place(g, B, n, m, k):
    """A place that gets everything, the others nothing."""
    return torch.full((B, m, k), n // 2)


def _few_places(g, B, n, m, k):
    """Most places get nothing, some much."""
    return torch.randint(0, n, (B, m, k), generator=g) // 7 * 7


def _padded(g, B, n, m, k):
    """As a ball query pads: the first neighbour again where there are no more."""
    index = _random(g, B, n, m, k)
    found = torch.randint(1, k + 1, (B, m, 1), generator=g)
    return torch.where(torch.arange(k) < found, index, index[..., :1])


def _all_different(g, B, n, m, k):
    """No two entries of a cloud send to one place, as far as the places last."""
    order = torch.stack([torch.randperm(n, generator=g) for _ in range(B)])
    return order[:, torch.arange(m * k) % n].view(B, m, k)


KINDS = [_random, _one_place, _few_places, _padded, _all_different]
# clouds, places, rows, neighbours, channels
SHAPES = [(1, 1, 1, 1, 1), (2, 9, 7, 4, 5), (3, 10, 5, 3, 65), (1, 5, 9, 8, 130), (2, 33, 9, 2, 3)]
USUAL = 2, 30, 12, 5, 7


@pytest.fixture(params=KINDS, ids=lambda make: make.__name__.strip("_"))
def kind(request):
    return request.param


def case(shape, dtype, make=_random):
    """Rows (B, n, C), a table, weights, and a gradient (B, M, C)."""
    B, n, m, k, c = shape
    g = torch.Generator().manual_seed(0)
    rows, grad = torch.randn(B, n, c, generator=g).to(dtype), torch.randn(B, m, c, generator=g).to(dtype)
    weight = torch.rand(B, m, k, generator=g).to(torch.promote_types(dtype, torch.float32))
    return rows, make(g, B, n, m, k), weight, grad


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_on_every_shape_results_are_the_references(here, shape, dtype):
    compare(here, *case(shape, dtype))


def test_on_every_kind_of_table_results_are_the_references(here, kind):
    compare(here, *case(USUAL, torch.float32, kind))


def compare(here, rows, index, weight, grad):
    """All three scatterings of the gradient."""
    n, dtype = rows.shape[1], rows.dtype
    with plain_operators():
        winner = OPERATORS["gather_max"](rows, index)[1]
        total, weighted = scatter_sum(grad, index, n), scatter_sum(grad, index, n, weight)
        most = OPERATORS["scatter_max"](grad, winner, index, n)
    grad, winner, index, weight = (here(t) for t in (grad, winner, index, weight))
    for found, expected in (
        (scattering.scatter_sum(grad, index, None, n), total),
        (scattering.scatter_sum(grad, index, weight, n), weighted),
        (scattering.scatter_max(grad, winner, index, n), most),
    ):
        assert found.dtype == dtype
        torch.testing.assert_close(found.cpu(), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sums_are_taken_in_the_order_of_the_table(here, kind, dtype):
    _, index, _, sent = case(USUAL, dtype, kind)
    expected = torch.zeros(2, 30, 7, dtype=dtype)
    for b, i, s in np.ndindex(index.shape):
        expected[b, index[b, i, s]] += sent[b, i]
    assert torch.equal(scattering.scatter_sum(here(sent), here(index), None, 30).cpu(), expected)


class Gathered(torch.autograd.Function):
    """What the operators do on a card, kernel by kernel."""

    @staticmethod
    def forward(ctx, rows, index, weight, most):
        ctx.n, ctx.most = rows.shape[1], most
        value, winner = gathering.gather_max(rows, index) if most else (None, None)
        ctx.save_for_backward(index, weight, winner)
        return value if most else gathering.gather_sum(rows, index, weight)

    @staticmethod
    def backward(ctx, grad):
        index, weight, winner = ctx.saved_tensors
        if ctx.most:
            return scattering.scatter_max(grad, winner, index, ctx.n), None, None, None
        return scattering.scatter_sum(grad, index, weight, ctx.n), None, None, None


@pytest.mark.parametrize("which", ["sum", "weighted sum", "maximum"])
def test_gradients_are_those_of_autograd_on_gathered_rows(here, kind, which):
    rows, index, weight, grad = case(USUAL, torch.float64, kind)
    weight = weight if which == "weighted sum" else None

    plain = rows.clone().requires_grad_()
    taken = plain[torch.arange(2)[:, None, None], index]
    if which == "maximum":
        first = taken.detach().argmax(2, keepdim=True)  # amax would share among equals
        taken.gather(2, first)[:, :, 0].backward(grad)
    else:
        (taken if weight is None else taken * weight[..., None]).sum(2).backward(grad)

    learned = here(rows.clone()).requires_grad_()
    Gathered.apply(learned, here(index), here(weight), which == "maximum").backward(here(grad))
    torch.testing.assert_close(learned.grad.cpu(), plain.grad, rtol=1e-12, atol=1e-12)


def test_gradients_are_those_of_the_operators(here):
    rows, index, weight, grad = case(USUAL, torch.float32, _padded)
    for most, operator in (
        (False, lambda r: gather_sum(r, index, weight)),
        (True, lambda r: gather_max(r, index)),
    ):
        plain, learned = rows.clone().requires_grad_(), here(rows.clone()).requires_grad_()
        operator(plain).backward(grad)
        Gathered.apply(learned, here(index), here(weight), most).backward(here(grad))
        torch.testing.assert_close(learned.grad.cpu(), plain.grad)


def test_two_runs_give_the_same_bits(here, kind):
    rows, index, weight, grad = (here(t) for t in case(USUAL, torch.float32, kind))
    winner = gathering.gather_max(rows, index)[1]
    for call in (
        lambda: scattering.scatter_sum(grad, index, weight, 30),
        lambda: scattering.scatter_max(grad, winner, index, 30),
    ):
        assert torch.equal(call(), call())


def test_a_row_that_names_its_winner_several_times_gives_its_gradient_once(here):
    index = torch.tensor([[[2, 0, 2, 2], [2, 2, 1, 1]]])
    winner = torch.tensor([[[2, 0], [2, 1]]], dtype=torch.int32)
    grad = torch.tensor([[[1.0, 10.0], [2.0, 20.0]]])
    found = scattering.scatter_max(here(grad), here(winner), here(index), 4).cpu()
    assert found.tolist() == [[[0, 10], [0, 20], [3, 0], [0, 0]]]


def test_short_numbers_are_added_up_in_single_precision(here):
    sent = torch.ones(1, 300, 1, dtype=torch.bfloat16)
    index = torch.zeros(1, 300, 1, dtype=torch.int64)
    # one by one in bfloat16 the sum would stop at 256
    assert scattering.scatter_sum(here(sent), here(index), None, 2).flatten().tolist() == [300, 0]
    found = scattering.scatter_max(here(sent), here(index.int()), here(index), 2)
    assert found.flatten().tolist() == [300, 0]


@pytest.mark.parametrize("bad", [-1, 4, 10**9, 2**32, -(2**63)])
def test_what_is_sent_outside_gets_nowhere(here, bad):
    sent = torch.arange(1.0, 7).view(2, 3, 1)
    index = torch.tensor([[[0, 3], [bad, 1], [1, bad]], [[bad, bad], [3, 3], [0, bad]]])
    found = scattering.scatter_sum(here(sent), here(index), None, 4).cpu()
    assert found[..., 0].tolist() == [[1, 5, 0, 1], [6, 0, 0, 10]]
    winner = torch.tensor([[[3], [1], [1]], [[0], [3], [0]]], dtype=torch.int32)
    found = scattering.scatter_max(here(sent), here(winner), here(index), 4).cpu()
    assert found[..., 0].tolist() == [[0, 5, 0, 1], [6, 0, 0, 5]]


@pytest.mark.parametrize("shape", [(2, 6, 0, 3, 4), (0, 6, 5, 3, 4)], ids=str)
def test_where_nothing_is_sent_sums_are_zero(here, shape):
    _, index, weight, sent = case(shape, torch.float32)
    expected = torch.zeros(shape[0], 6, shape[4])
    assert torch.equal(scattering.scatter_sum(here(sent), here(index), here(weight), 6).cpu(), expected)
    found = scattering.scatter_max(here(sent), here(sent.int()), here(index), 6)
    assert torch.equal(found.cpu(), expected)


def test_entries_are_sorted_by_place_and_in_the_order_of_the_table(here):
    index = torch.randint(-1, 8, (3, 6, 5), generator=torch.Generator().manual_seed(0))
    entry, start = scattering.senders(here(index), 7)
    place = np.arange(3)[:, None, None] * 7 + index.numpy()
    outside = (index.numpy() < 0) | (index.numpy() >= 7)
    place = np.where(outside, 21, place).ravel()
    assert outside.any() and entry.dtype == start.dtype == torch.int32
    assert entry.tolist() == np.argsort(place, kind="stable").tolist()
    assert start.tolist() == np.searchsorted(np.sort(place), np.arange(22)).tolist()


def test_tables_too_large_for_short_numbers_are_counted_in_long_ones(here, monkeypatch):
    assert scattering._counting(2**31 - 1) == torch.int32 and scattering._counting(2**31) == torch.int64
    rows, index, weight, grad = (here(t) for t in case((2, 9, 7, 4, 5), torch.float32, _padded))
    winner = gathering.gather_max(rows, index)[1]

    def run():
        spread = scattering.scatter_sum(grad, index, weight, 9)
        return spread, scattering.scatter_max(grad, winner, index, 9), *scattering.senders(index, 9)

    short = run()
    monkeypatch.setattr(scattering, "_counting", lambda most: torch.int64)
    long = run()
    assert long[2].dtype == long[3].dtype == torch.int64
    assert all(torch.equal(a, b.to(a.dtype)) for a, b in zip(short, long, strict=True))


def test_how_tensors_lie_in_memory_does_not_matter(here):
    rows, index, weight, grad = (here(t) for t in case((3, 9, 7, 4, 5), torch.float32))
    winner = gathering.gather_max(rows, index)[1]
    plain = grad, winner, index, weight
    apart = [t.mT.contiguous().mT for t in plain]
    assert not any(t.is_contiguous() for t in apart)
    for call in (
        lambda g, w, i, x: scattering.scatter_sum(g, i, x, 9),
        lambda g, w, i, x: scattering.scatter_max(g, w, i, 9),
    ):
        assert torch.equal(call(*apart), call(*plain))


def test_a_table_that_does_not_fit_is_refused(here):
    sent, index = here(torch.rand(1, 4, 2)), here(torch.zeros(1, 5, 1, dtype=torch.int64))
    with pytest.raises(ValueError, match="does not fit rows"):
        scattering.scatter_sum(sent, index, None, 3)
    with pytest.raises(ValueError, match=r"winners \(1, 4, 1\) do not fit a gradient \(1, 4, 2\)"):
        scattering.scatter_max(sent, here(torch.zeros(1, 4, 1, dtype=torch.int32)), index[:, :4], 3)
    with pytest.raises(ValueError, match="weights"):
        scattering.scatter_sum(sent, index[:, :4], here(torch.rand(1, 4, 2)), 3)
