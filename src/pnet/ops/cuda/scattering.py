"""The reverse of gathering: what the rows send to a place is added up by the place.

The table is turned round first: its entries sorted by place, and where each place's begin. So every sum has
one owner and one order, the table's: no atomic addition, and the same result in every run.

Places differ much: most get some rows, but from a ball query the first points of a cloud get hundreds. A
program of one warp therefore owns a few places and goes on to the largest count among them: many small
programs even out, and one with a long way holds up nobody but its few neighbours. Several entries are read
before the first is added, because reading is what a program waits for.
"""

from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.gathering import precise
from pnet.ops.cuda.launch import block, on_device_of
from pnet.ops.gathering import check_table
from pnet.ops.grouping import check_winners

PLACES, CHANNELS = 16, 64  # of a program's block, at most
NUMBERS = 256  # of a program's block, at most: eight for each lane
AT_ONCE = 4  # entries of a place
KEYS = 1024  # of a program that makes them


class Senders(NamedTuple):
    """The entries of a table (B, M, k) in the order of the places that they send to.

    Attributes:
        entry: (B · M · k,) (b · M + i) · k + s, ascending for each place; those outside [0, n) come last.
        start: (B · n + 1,) place j of cloud b has those from start[b · n + j] up to the next start.
        Both int32 where that is enough, else int64.
    """

    entry: Tensor
    start: Tensor


def scatter_sum(rows: Tensor, index: Tensor, weight: Tensor | None, n: int) -> Tensor:
    """See `pnet.ops.gathering`."""
    check_table(index, rows, 2, weight)
    return _scatter(_scatter_sum, rows, weight, index, n, WEIGHTED=weight is not None)


def scatter_max(grad: Tensor, winner: Tensor, index: Tensor, n: int) -> Tensor:
    """See `pnet.ops.gathering`."""
    check_table(index, grad, 2)
    check_winners(winner, grad)
    return _scatter(_scatter_max, grad, winner, index, n)


def senders(index: Tensor, n: int) -> Senders:
    """Of a table (B, M, k) into n places."""
    B, entries = len(index), index.numel()
    key = torch.empty(entries, dtype=_counting(B * n), device=index.device)
    if entries:
        with on_device_of(index):
            _keys[triton.cdiv(entries // B, KEYS), B](
                index.contiguous(), key, entries // B, n, B * n, SIZE=KEYS
            )
    key, entry = torch.sort(key, stable=True)
    place = torch.arange(B * n + 1, dtype=key.dtype, device=index.device)
    start = torch.searchsorted(key, place, out_int32=_counting(entries) == torch.int32)
    return Senders(entry.to(start.dtype), start)


def _counting(most: int) -> torch.dtype:
    """Of whole numbers up to `most`: half the bytes where they are enough."""
    return torch.int32 if most < 2**31 else torch.int64


def _scatter(
    kernel: Any, rows: Tensor, other: Tensor | None, index: Tensor, n: int, **constants: Any
) -> Tensor:
    """Launch over all places; `other` is (B, M, k) weights or (B, M, C) winners."""
    rows = rows.contiguous()
    B, _, c = rows.shape
    out = rows.new_empty(B, n, c)
    if out.numel():
        C = block(c, CHANNELS)
        R = block(n, min(PLACES, NUMBERS // C))
        with on_device_of(rows):
            kernel[triton.cdiv(n, R), triton.cdiv(c, C), B](
                rows, rows if other is None else other.contiguous(), *senders(index, n), out, n, c,
                K=index.shape[2], SUM=precise(rows), R=R, C=C, U=AT_ONCE, num_warps=1, **constants,
            )  # fmt: skip
    return out


@triton.jit
def _keys(index, key, per_cloud, n, outside, SIZE: tl.constexpr):
    """key[b, e] = b · n + index[b, e], the place's number among those of all clouds; else `outside`."""
    e = tl.program_id(0) * SIZE + tl.arange(0, SIZE)
    b = tl.program_id(1).to(tl.int64)
    j = tl.load(index + b * per_cloud + e, mask=e < per_cloud, other=0)
    place = tl.where((j >= 0) & (j < n), b * n + j, outside)
    tl.store(key + b * per_cloud + e, place.to(key.dtype.element_ty), mask=e < per_cloud)


@triton.jit
def _scatter_sum(
    rows, weight, entry, start, out, n, c,
    K: tl.constexpr, SUM: tl.constexpr, R: tl.constexpr, C: tl.constexpr, U: tl.constexpr,
    WEIGHTED: tl.constexpr,
):  # fmt: skip
    """out[place] = Σ weight[entry] · rows[entry // K] over the place's entries."""
    j = tl.program_id(0) * R + tl.arange(0, R)
    channel = tl.program_id(1) * C + tl.arange(0, C)
    place = tl.program_id(2).to(tl.int64) * n + j
    own = (j < n)[:, None] & (channel < c)[None, :]
    first = tl.load(start + place, mask=j < n, other=0)
    count = tl.load(start + place + 1, mask=j < n, other=0) - first
    total = tl.zeros((R, C), SUM)
    for done in range(0, tl.max(count, 0), U):
        for u in tl.static_range(U):
            inside = done + u < count
            e = tl.load(entry + first + done + u, mask=inside, other=0)
            at = (e // K).to(tl.int64)[:, None] * c + channel[None, :]
            row = tl.load(rows + at, mask=own & inside[:, None], other=0.0).to(SUM)
            if WEIGHTED:
                row *= tl.load(weight + e, mask=inside, other=0.0).to(SUM)[:, None]
            total += row
    tl.store(out + place[:, None] * c + channel[None, :], total.to(out.dtype.element_ty), mask=own)


@triton.jit
def _scatter_max(
    grad, winner, entry, start, out, n, c,
    K: tl.constexpr, SUM: tl.constexpr, R: tl.constexpr, C: tl.constexpr, U: tl.constexpr,
):  # fmt: skip
    """out[place] = Σ grad[i] over the rows i that it won; a row that names it twice counts once."""
    j = tl.program_id(0) * R + tl.arange(0, R)
    channel = tl.program_id(1) * C + tl.arange(0, C)
    place = tl.program_id(2).to(tl.int64) * n + j
    own = (j < n)[:, None] & (channel < c)[None, :]
    first = tl.load(start + place, mask=j < n, other=0)
    count = tl.load(start + place + 1, mask=j < n, other=0) - first
    total = tl.zeros((R, C), SUM)
    before = tl.full((R,), -1, entry.dtype.element_ty)
    for done in range(0, tl.max(count, 0), U):
        for u in tl.static_range(U):
            inside = done + u < count
            i = tl.load(entry + first + done + u, mask=inside, other=0) // K
            at = i.to(tl.int64)[:, None] * c + channel[None, :]
            once = own & (inside & (i != before))[:, None]  # a place's entries of one row follow each other
            won = tl.load(winner + at, mask=once, other=-1) == j[:, None]
            total += tl.where(won, tl.load(grad + at, mask=once, other=0.0).to(SUM), 0.0)
            before = i
    tl.store(out + place[:, None] * c + channel[None, :], total.to(out.dtype.element_ty), mask=own)
