"""Gathering rows, and its reverse.

A gathered row has one owner. The reverse goes through a table of the places that take from each row, sorted
by place, so that every sum has one owner and one order there as well: no atomic addition.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.launch import block, on_device_of

ROWS, CHANNELS = 16, 64  # of a program's block, at most


def gather_sum(rows: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    """See `pnet.ops.gathering`."""
    rows, index = rows.contiguous(), index.contiguous()
    B, m, k = index.shape
    n, c = rows.shape[1:]
    out = rows.new_empty(B, m, c)
    R, C = block(m, ROWS), block(c, CHANNELS)
    if out.numel():
        with on_device_of(rows):
            _gather_sum[triton.cdiv(m, R), triton.cdiv(c, C), B](
                rows, index, index if weight is None else weight.contiguous(), out, n, m, c,
                K=k, WEIGHTED=weight is not None, SUM=_accumulator(rows), R=R, C=C,
            )  # fmt: skip
    return out


def _accumulator(rows: Tensor) -> tl.dtype:
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
    for s in range(K):
        entry = (b * m + i) * K + s
        j = tl.load(index + entry, mask=i < m, other=0)
        inside = own & ((j >= 0) & (j < n))[:, None]
        row = tl.load(rows + (b * n + j)[:, None] * c + channel[None, :], inside, float("nan")).to(SUM)
        if WEIGHTED:
            row *= tl.load(weight + entry, mask=i < m, other=0.0).to(SUM)[:, None]
        total += row
    tl.store(out + (b * m + i)[:, None] * c + channel[None, :], total.to(out.dtype.element_ty), mask=own)
