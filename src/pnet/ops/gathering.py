"""Gathering rows of features by a table of indices, with backward; for every cloud of a batch.

A linear layer commutes with gathering: W [f_j; x_j − x_i] = (W_f f_j + W_x x_j) − W_x x_i. So backbones apply
it per point first, gather its rows and subtract the centre's: n products, not M k for M centres of k
neighbours. With two neighbours side by side W [f_a; f_b] = W_a f_a + W_b f_b is `gather_sum` over two rows.
"""

from typing import Any

import torch
from torch import Tensor

from pnet.ops.grouping import first_largest
from pnet.ops.operators import kernel, operator


def gather_rows(rows: Tensor, index: Tensor) -> Tensor:
    """Rows of each cloud by index.

    Args:
        rows: (B, n, C). index: (B, ...) int64 into n.
    Returns:
        (B, ..., C).
    """
    taken: Tensor = _gather_sum(rows, index.flatten(1)[..., None], None)
    return taken.view(*index.shape, rows.shape[-1])


def gather_sum(rows: Tensor, index: Tensor, weight: Tensor | None = None) -> Tensor:
    """(Weighted) sums of gathered rows; the weights get no gradient.

    Args:
        rows: (B, n, C). index: (B, M, k) int64 into n. weight: (B, M, k), or None for plain sums.
    Returns:
        (B, M, C).
    """
    total: Tensor = _gather_sum(rows, index, None if weight is None else weight.detach())
    return total


def scatter_sum(rows: Tensor, index: Tensor, n: int, weight: Tensor | None = None) -> Tensor:
    """(Weighted) sums of the rows that are sent to each place: the reverse of `gather_sum`.

    Args:
        rows: (B, M, C). index: (B, M, k) int64 into n: where each row goes. n: places.
        weight: (B, M, k), or None for plain sums.
    Returns:
        (B, n, C), zeros where nothing is sent; added in the rows' order, so the same in every run.
    """
    total: Tensor = _scatter_sum(rows, index, None if weight is None else weight.detach(), n)
    return total


def gather_max(rows: Tensor, index: Tensor) -> Tensor:
    """The largest of the gathered rows, channel by channel, without holding them all.

    Args:
        rows: (B, n, C). index: (B, M, k) int64 into n.
    Returns:
        (B, M, C). The gradient goes to the winner; among equal ones to the first in the table.
    """
    largest: Tensor = _gather_max(rows, index)[0]
    return largest


@operator
def _gather_sum(rows: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    taken = _gathered(rows, index).to(_precise(rows))
    return (taken if weight is None else taken * weight[..., None].to(taken)).sum(2).to(rows)


@operator
def _scatter_sum(rows: Tensor, index: Tensor, weight: Tensor | None, n: int) -> Tensor:
    """The reverse of `_gather_sum`: (B, M, C) → (B, n, C)."""
    spread = rows[:, :, None].expand(*index.shape, rows.shape[2]).to(_precise(rows))
    if weight is not None:
        spread = spread * weight[..., None].to(spread)
    out = spread.new_zeros(len(rows), n, rows.shape[2])
    return out.scatter_add(1, _wide(index, rows.shape[2]), spread.flatten(1, 2)).to(rows)


@operator
def _gather_max(rows: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """The maximum, and the row (B, M, C) int32 that each channel comes from."""
    largest, first = first_largest(_gathered(rows, index))
    return largest, index.gather(2, first).int()


@operator
def _scatter_max(grad: Tensor, winner: Tensor, index: Tensor, n: int) -> Tensor:
    """The reverse of `_gather_max`: (B, M, C) → (B, n, C); winners are in their row of the table."""
    out = grad.new_zeros(len(grad), n, grad.shape[2], dtype=_precise(grad))
    return out.scatter_add(1, winner.long(), grad.to(out)).to(grad)


@kernel(_gather_sum, "cpu")
def _(rows: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    from pnet.ops.cpu import gathering as kernels

    return kernels.gather_sum(rows, index, weight)


@kernel(_scatter_sum, "cpu")
def _(rows: Tensor, index: Tensor, weight: Tensor | None, n: int) -> Tensor:
    from pnet.ops.cpu import gathering as kernels

    return kernels.scatter_sum(rows, index, weight, n)


@kernel(_gather_max, "cpu")
def _(rows: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    from pnet.ops.cpu import gathering as kernels

    return kernels.gather_max(rows, index)


@kernel(_scatter_max, "cpu")
def _(grad: Tensor, winner: Tensor, index: Tensor, n: int) -> Tensor:
    from pnet.ops.cpu import gathering as kernels

    return kernels.scatter_max(grad, winner, n)


@kernel(_gather_sum, "cuda")
def _(rows: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    from pnet.ops.cuda import gathering as kernels

    return kernels.gather_sum(rows, index, weight)


@kernel(_scatter_sum, "cuda")
def _(rows: Tensor, index: Tensor, weight: Tensor | None, n: int) -> Tensor:
    from pnet.ops.cuda import scattering as kernels

    return kernels.scatter_sum(rows, index, weight, n)


@kernel(_gather_max, "cuda")
def _(rows: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    from pnet.ops.cuda import gathering as kernels

    return kernels.gather_max(rows, index)


@kernel(_scatter_max, "cuda")
def _(grad: Tensor, winner: Tensor, index: Tensor, n: int) -> Tensor:
    from pnet.ops.cuda import scattering as kernels

    return kernels.scatter_max(grad, winner, index, n)


@_gather_sum.register_fake
def _(rows: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    return rows.new_empty(*index.shape[:2], rows.shape[2])


@_scatter_sum.register_fake
def _(rows: Tensor, index: Tensor, weight: Tensor | None, n: int) -> Tensor:
    return rows.new_empty(rows.shape[0], n, rows.shape[2])


@_gather_max.register_fake
def _(rows: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    shape = (*index.shape[:2], rows.shape[2])
    return rows.new_empty(shape), rows.new_empty(shape, dtype=torch.int32)


@_scatter_max.register_fake
def _(grad: Tensor, winner: Tensor, index: Tensor, n: int) -> Tensor:
    return grad.new_empty(grad.shape[0], n, grad.shape[2])


def _keep_sum(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    rows, index, weight = inputs
    ctx.save_for_backward(index, weight)
    ctx.n = rows.shape[1]


def _sum_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
    index, weight = ctx.saved_tensors
    return _scatter_sum(grad, index, weight, ctx.n), None, None


def _keep_scatter(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[1:3])


def _scatter_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
    index, weight = ctx.saved_tensors
    return _gather_sum(grad, index, weight), None, None, None


def _keep_max(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.save_for_backward(output[1], inputs[1])
    ctx.n = inputs[0].shape[1]


def _max_backward(ctx: Any, grad: Tensor, _: None) -> tuple[Tensor, None]:
    return _scatter_max(grad, *ctx.saved_tensors, ctx.n), None


_gather_sum.register_autograd(_sum_backward, setup_context=_keep_sum)
_scatter_sum.register_autograd(_scatter_backward, setup_context=_keep_scatter)
_gather_max.register_autograd(_max_backward, setup_context=_keep_max)


def check_table(index: Tensor, rows: Tensor, axes: int, weight: Tensor | None = None) -> None:
    """For kernels, which read where they are told.

    Raises:
        ValueError: where the table's first `axes` axes are not the rows', it has no neighbours, or the
            weights are not its own.
    """
    if index.shape[:axes] != rows.shape[:axes] or index.shape[2] == 0:
        raise ValueError(f"a table of shape {tuple(index.shape)} does not fit rows {tuple(rows.shape)}")
    if weight is not None and weight.shape != index.shape:
        raise ValueError(f"weights {tuple(weight.shape)} do not fit a table of shape {tuple(index.shape)}")


def _gathered(rows: Tensor, index: Tensor) -> Tensor:
    """(B, n, C), (B, M, k) → (B, M, k, C)."""
    return torch.gather(rows, 1, _wide(index, rows.shape[2])).view(*index.shape, rows.shape[2])


def _precise(rows: Tensor) -> torch.dtype:
    """Sums of short numbers are taken in float32."""
    return torch.promote_types(rows.dtype, torch.float32)


def _wide(index: Tensor, channels: int) -> Tensor:
    return index.flatten(1)[..., None].expand(-1, -1, channels)
