"""Gathering rows, and its reverse.

Scattering is divided by cloud and channels, not by row: every sum has one owner and one order.
"""

import torch
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array
from pnet.ops.gathering import check_table
from pnet.ops.grouping import check_winners

BLOCK = 16  # channels that one owner adds up, at least: a cache line of float32
ROWS = 64  # rows that pay for a thread
NONE = torch.empty(0, 0, 0)


def gather_sum(rows: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    """See `pnet.ops.gathering`."""
    check_table(index, rows, 1, weight)
    _check(index, rows.shape[1])
    values = full(rows)
    out = values.new_empty(*index.shape[:2], rows.shape[2])
    arrays = values.numpy(), index.contiguous().numpy(), _weight(weight, values).numpy(), out.numpy()
    in_parts(lambda a, b: _gather_sum(*arrays, a, b), index.shape[0] * index.shape[1], ROWS)
    return out.to(rows.dtype)


def scatter_sum(rows: Tensor, index: Tensor, weight: Tensor | None, n: int) -> Tensor:
    """See `pnet.ops.gathering`."""
    check_table(index, rows, 2, weight)
    _check(index, n)
    values = full(rows)
    out = values.new_zeros(len(rows), n, rows.shape[2])
    arrays = values.numpy(), index.contiguous().numpy(), _weight(weight, values).numpy(), out.numpy()
    blocks = _blocks(rows)
    in_parts(lambda a, b: _scatter_sum(*arrays, blocks, a, b), len(rows) * blocks)
    return out.to(rows.dtype)


def gather_max(rows: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """See `pnet.ops.gathering`."""
    check_table(index, rows, 1)
    _check(index, rows.shape[1])
    values = full(rows)
    out = values.new_empty(*index.shape[:2], rows.shape[2])
    winner = torch.empty(out.shape, dtype=torch.int32)
    arrays = values.numpy(), index.contiguous().numpy(), out.numpy(), winner.numpy()
    in_parts(lambda a, b: _gather_max(*arrays, a, b), index.shape[0] * index.shape[1], ROWS)
    return out.to(rows.dtype), winner


def scatter_max(grad: Tensor, winner: Tensor, n: int) -> Tensor:
    """See `pnet.ops.gathering`."""
    check_winners(winner, grad)
    _check(winner, n)
    values = full(grad)
    out = values.new_zeros(len(grad), n, grad.shape[2])
    arrays = values.numpy(), winner.contiguous().numpy(), out.numpy()
    blocks = _blocks(grad)
    in_parts(lambda a, b: _scatter_max(*arrays, blocks, a, b), len(grad) * blocks)
    return out.to(grad.dtype)


def _check(index: Tensor, n: int) -> None:
    """Compiled code reads where it is told: a table of another cloud must not get there."""
    low, high = index.aminmax() if index.numel() else (0, 0)
    if low < 0 or high >= max(n, 1):
        raise IndexError(f"index {int(low)} to {int(high)} into {n} rows: a table of another cloud?")


def full(rows: Tensor) -> Tensor:
    """Contiguous float32 or float64: numba knows no shorter ones."""
    short = rows.dtype in (torch.bfloat16, torch.float16)
    return (rows.float() if short else rows).detach().contiguous()


def _weight(weight: Tensor | None, values: Tensor) -> Tensor:
    return NONE.to(values) if weight is None else weight.detach().to(values).contiguous()


def _blocks(rows: Tensor) -> int:
    """Into how many blocks the channels are divided: no more than there are threads for."""
    return max(1, min(-(-torch.get_num_threads() // len(rows)), rows.shape[2] // BLOCK)) if len(rows) else 1


@kernel
def _gather_sum(rows: Array, index: Array, weight: Array, out: Array, start: int, stop: int) -> None:
    m, k, c = index.shape[1], index.shape[2], rows.shape[2]
    for row in range(start, stop):
        b, i = row // m, row % m
        to = out[b, i]
        if weight.size:
            for j in range(c):
                to[j] = 0
            for s in range(k):
                at, w = rows[b, index[b, i, s]], weight[b, i, s]
                for j in range(c):
                    to[j] += w * at[j]
        else:
            at = rows[b, index[b, i, 0]]
            for j in range(c):
                to[j] = at[j]
            for s in range(1, k):
                at = rows[b, index[b, i, s]]
                for j in range(c):
                    to[j] += at[j]


@kernel
def _scatter_sum(
    rows: Array, index: Array, weight: Array, out: Array, blocks: int, start: int, stop: int
) -> None:
    m, k, c = index.shape[1], index.shape[2], rows.shape[2]
    for block in range(start, stop):
        b, part = block // blocks, block % blocks
        low, high = c * part // blocks, c * (part + 1) // blocks
        for i in range(m):
            at = rows[b, i, low:high]
            for s in range(k):
                to = out[b, index[b, i, s], low:high]
                if weight.size:
                    w = weight[b, i, s]
                    for j in range(high - low):
                        to[j] += w * at[j]
                else:
                    for j in range(high - low):
                        to[j] += at[j]


@kernel
def _gather_max(rows: Array, index: Array, out: Array, winner: Array, start: int, stop: int) -> None:
    m, k, c = index.shape[1], index.shape[2], rows.shape[2]
    for row in range(start, stop):
        b, i = row // m, row % m
        to, who = out[b, i], winner[b, i]
        first = index[b, i, 0]
        at = rows[b, first]
        for j in range(c):
            to[j], who[j] = at[j], first
        for s in range(1, k):
            source = index[b, i, s]
            if source == first:  # a padded table repeats its first entry
                continue
            at = rows[b, source]
            for j in range(c):
                # not-a-number wins, so that it is seen
                better = at[j] > to[j] or (at[j] != at[j] and to[j] == to[j])
                to[j] = at[j] if better else to[j]
                who[j] = source if better else who[j]


@kernel
def _scatter_max(grad: Array, winner: Array, out: Array, blocks: int, start: int, stop: int) -> None:
    m, c = grad.shape[1], grad.shape[2]
    for block in range(start, stop):
        b, part = block // blocks, block % blocks
        low, high = c * part // blocks, c * (part + 1) // blocks
        for i in range(m):
            for j in range(low, high):
                out[b, winner[b, i, j], j] += grad[b, i, j]
