"""Gathering rows: sums, and maxima with the row that each channel comes from.

A program owns a block of gathered rows × channels, and takes their neighbours in the table's order.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.launch import block, on_device_of
from pnet.ops.gathering import check_table

ROWS, CHANNELS = 16, 64  # of a program's block, at most


def gather_sum(rows: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    """See `pnet.ops.gathering`."""
    check_table(index, rows, 1, weight)
    rows, index = rows.contiguous(), index.contiguous()
    B, m, k = index.shape
    n, c = rows.shape[1:]
    out = rows.new_empty(B, m, c)
    R, C = block(m, ROWS), block(c, CHANNELS)
    if out.numel():
        with on_device_of(rows):
            _gather_sum[triton.cdiv(m, R), triton.cdiv(c, C), B](
                rows, index, index if weight is None else weight.contiguous(), out, n, m, c,
                K=k, WEIGHTED=weight is not None, SUM=precise(rows), R=R, C=C,
            )  # fmt: skip
    return out


def gather_max(rows: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """See `pnet.ops.gathering`."""
    check_table(index, rows, 1)
    rows, index = rows.contiguous(), index.contiguous()
    B, m, k = index.shape
    n, c = rows.shape[1:]
    out = rows.new_empty(B, m, c)
    winner = torch.empty_like(out, dtype=torch.int32)
    R, C = block(m, ROWS), block(c, CHANNELS)
    if out.numel():
        with on_device_of(rows):
            _gather_max[triton.cdiv(m, R), triton.cdiv(c, C), B](
                rows, index, out, winner, n, m, c, K=k, VALUE=precise(rows), R=R, C=C
            )
    return out, winner


def precise(rows: Tensor) -> tl.dtype:
    """Sums of short numbers are taken in float32."""
    return tl.float64 if rows.dtype == torch.float64 else tl.float32


@triton.jit
def _gather_sum(
    rows, index, weight, out, n, m, c,
    K: tl.constexpr, WEIGHTED: tl.constexpr, SUM: tl.constexpr, R: tl.constexpr, C: tl.constexpr,
):  # fmt: skip
    """out[b, i] = Σ_s weight[b, i, s] · rows[b, index[b, i, s]]; a place outside [0, n) gives NaN."""
    i = tl.program_id(0) * R + tl.arange(0, R)
    channel = tl.program_id(1) * C + tl.arange(0, C)
    b = tl.program_id(2).to(tl.int64)
    own = (i < m)[:, None] & (channel < c)[None, :]
    total = tl.zeros((R, C), SUM)
    for s in tl.range(K, loop_unroll_factor=4):
        entry = (b * m + i) * K + s
        j = tl.load(index + entry, mask=i < m, other=0)
        inside = own & ((j >= 0) & (j < n))[:, None]
        row = tl.load(rows + (b * n + j)[:, None] * c + channel[None, :], inside, float("nan")).to(SUM)
        if WEIGHTED:
            row *= tl.load(weight + entry, mask=i < m, other=0.0).to(SUM)[:, None]
        total += row
    tl.store(out + (b * m + i)[:, None] * c + channel[None, :], total.to(out.dtype.element_ty), mask=own)


@triton.jit
def _gather_max(
    rows, index, out, winner, n, m, c,
    K: tl.constexpr, VALUE: tl.constexpr, R: tl.constexpr, C: tl.constexpr,
):  # fmt: skip
    """The first largest row of each channel; a place outside [0, n) is not a number, and wins."""
    i = tl.program_id(0) * R + tl.arange(0, R)
    channel = tl.program_id(1) * C + tl.arange(0, C)
    b = tl.program_id(2).to(tl.int64)
    own = (i < m)[:, None] & (channel < c)[None, :]
    largest = tl.full((R, C), float("-inf"), VALUE)
    entry = index + (b * m + i) * K
    first = tl.broadcast_to(tl.load(entry, mask=i < m, other=0).to(tl.int32)[:, None], (R, C))
    for s in tl.range(K, loop_unroll_factor=4):
        j = tl.load(entry + s, mask=i < m, other=0)
        inside = own & ((j >= 0) & (j < n))[:, None]
        row = tl.load(rows + (b * n + j)[:, None] * c + channel[None, :], inside, float("nan")).to(VALUE)
        better = ~(row <= largest) & (largest == largest)  # so is not-a-number, but not another one
        largest = tl.where(better, row, largest)
        first = tl.where(better, j.to(tl.int32)[:, None], first)
    at = (b * m + i)[:, None] * c + channel[None, :]
    tl.store(out + at, largest.to(out.dtype.element_ty), mask=own)
    tl.store(winner + at, first, mask=own)
