"""The largest row of groups that stand in a row, and its reverse: each number is read and written once."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.gathering import precise
from pnet.ops.cuda.launch import block, on_device_of
from pnet.ops.grouping import check_winners

GROUPS, CHANNELS = 16, 64  # of a program's block, at most


def group_max(rows: Tensor) -> tuple[Tensor, Tensor]:
    """See `pnet.ops.grouping`."""
    B, m, k, c = rows.shape
    if k == 0:
        raise ValueError(f"groups of shape {tuple(rows.shape)} have no rows")
    rows = rows.contiguous()
    out = rows.new_empty(B, m, c)
    winner = torch.empty_like(out, dtype=torch.int32)
    R, C = block(B * m, GROUPS), block(c, CHANNELS)
    if out.numel():
        with on_device_of(rows):
            _group_max[triton.cdiv(B * m, R), triton.cdiv(c, C)](
                rows, out, winner, B * m, c, K=k, VALUE=precise(rows), R=R, C=C
            )
    return out, winner


def ungroup_max(grad: Tensor, winner: Tensor, k: int) -> Tensor:
    """See `pnet.ops.grouping`."""
    check_winners(winner, grad)
    B, m, c = grad.shape
    out = grad.new_empty(B, m, k, c)
    R, C = block(B * m, GROUPS), block(c, CHANNELS)
    if out.numel():
        with on_device_of(grad):
            _ungroup_max[triton.cdiv(B * m, R), triton.cdiv(c, C)](
                grad.contiguous(), winner.contiguous(), out, B * m, c, K=k, R=R, C=C
            )
    return out


@triton.jit
def _group_max(
    rows, out, winner, groups, c,
    K: tl.constexpr, VALUE: tl.constexpr, R: tl.constexpr, C: tl.constexpr,
):  # fmt: skip
    """The first largest row of each channel; not-a-number wins, so that it is seen."""
    i = tl.program_id(0).to(tl.int64) * R + tl.arange(0, R)
    channel = tl.program_id(1) * C + tl.arange(0, C)
    own = (i < groups)[:, None] & (channel < c)[None, :]
    largest = tl.full((R, C), float("-inf"), VALUE)
    first = tl.zeros((R, C), tl.int32)
    for s in tl.range(K, loop_unroll_factor=4):
        row = tl.load(rows + (i * K + s)[:, None] * c + channel[None, :], mask=own, other=0.0).to(VALUE)
        better = ~(row <= largest) & (largest == largest)  # so is not-a-number, but not another one
        largest = tl.where(better, row, largest)
        first = tl.where(better, s, first)
    at = i[:, None] * c + channel[None, :]
    tl.store(out + at, largest.to(out.dtype.element_ty), mask=own)
    tl.store(winner + at, first, mask=own)


@triton.jit
def _ungroup_max(grad, winner, out, groups, c, K: tl.constexpr, R: tl.constexpr, C: tl.constexpr):
    """out[i, s] = grad[i] where winner[i] is s, else 0."""
    i = tl.program_id(0).to(tl.int64) * R + tl.arange(0, R)
    channel = tl.program_id(1) * C + tl.arange(0, C)
    own = (i < groups)[:, None] & (channel < c)[None, :]
    at = i[:, None] * c + channel[None, :]
    value = tl.load(grad + at, mask=own, other=0.0)
    first = tl.load(winner + at, mask=own, other=0)
    for s in range(K):
        given = tl.where(first == s, value, 0.0).to(out.dtype.element_ty)
        tl.store(out + (i * K + s)[:, None] * c + channel[None, :], given, mask=own)
