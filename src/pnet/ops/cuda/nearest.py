"""The k nearest points of every query, by trying all.

A thread has a query of its own and sees one point after another, in rising number and at the same time as
its neighbours: one load serves the warp, nothing is exchanged, and of equally near points the first stays in
front by itself. Four are kept in registers; where more are asked for, the next pass takes those behind them.
Squared distances must be finite numbers: what overflows is not found.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.buckets import coordinates
from pnet.ops.cuda.launch import EXACT, on_device_of

QUERIES = 64  # of a program: one a thread of two warps
KEPT = 4  # of a pass
STEP = 4  # points of a loop's turn


def nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k nearest, by distance, then index; see `pnet.ops.neighbours`."""
    points, queries = points.contiguous(), queries.contiguous()
    B, m, _ = queries.shape
    index = torch.empty(B, m, k, dtype=torch.int64, device=points.device)
    square = points.new_empty(B, m, k)
    with on_device_of(points):
        _nearest[B * triton.cdiv(m, QUERIES),](
            points, queries, index, square, points.shape[1], m,
            K=k, KEPT=min(k, KEPT), STEP=STEP, QUERIES=QUERIES, num_warps=2, **EXACT,
        )  # fmt: skip
    return index, square


@triton.jit(do_not_specialize=["n", "m"])
def _nearest(
    points, queries, index, square, n, m,
    K: tl.constexpr, KEPT: tl.constexpr, STEP: tl.constexpr, QUERIES: tl.constexpr,
):  # fmt: skip
    """index[b, i] and square[b, i] of some queries."""
    programs = tl.cdiv(m, QUERIES)
    b = (tl.program_id(0) // programs).to(tl.int64)
    i = tl.program_id(0) % programs * QUERIES + tl.arange(0, QUERIES)
    points += b * n * 3
    row = b * m + i
    x, y, z = coordinates(queries + tl.where(i < m, row, b * m) * 3, 1)
    index += row * K
    square += row * K
    last, who = x, i  # not looked at by the first pass
    last, who = _pass(points, x, y, z, last, who, index, square, 0, i < m, n, K, KEPT, STEP, LATER=False)
    for first in range(KEPT, K, KEPT):
        last, who = _pass(
            points, x, y, z, last, who, index, square, first, i < m, n, K, KEPT, STEP, LATER=True
        )


@triton.jit
def _pass(
    points, x, y, z, last, last_who, index, square, first, own, n,
    K: tl.constexpr, KEPT: tl.constexpr, STEP: tl.constexpr, LATER: tl.constexpr,
):  # fmt: skip
    """Find and write the next KEPT, those behind (last, last_who); the last of them."""
    # blocks and not numbers, so that a turn leaves them of the type it found them
    d0 = tl.full(x.shape, float("inf"), x.dtype)
    i0 = tl.zeros(x.shape, tl.int32)
    d1, d2, d3 = d0, d0, d0
    i1, i2, i3 = i0, i0, i0
    whole = n // STEP * STEP
    for j in range(0, whole, STEP):
        for u in tl.static_range(STEP):
            d = _distance(points, j + u, x, y, z, last, last_who, LATER)
            d0, i0, d1, i1, d2, i2, d3, i3 = _insert(d, j + u, d0, i0, d1, i1, d2, i2, d3, i3, KEPT)
    for j in range(whole, n):
        d = _distance(points, j, x, y, z, last, last_who, LATER)
        d0, i0, d1, i1, d2, i2, d3, i3 = _insert(d, j, d0, i0, d1, i1, d2, i2, d3, i3, KEPT)
    _write(index + first, square + first, i0, d0, own)
    if KEPT > 1:
        _write(index + first + 1, square + first + 1, i1, d1, own & (first + 1 < K))
    if KEPT > 2:
        _write(index + first + 2, square + first + 2, i2, d2, own & (first + 2 < K))
    if KEPT > 3:
        _write(index + first + 3, square + first + 3, i3, d3, own & (first + 3 < K))
    return d3, i3


@triton.jit
def _distance(points, j, x, y, z, last, last_who, LATER: tl.constexpr):
    """Squared distances of a point; infinite where the pass before was as far."""
    px, py, pz = coordinates(points + j * 3, 1)
    dx, dy, dz = px - x, py - y, pz - z
    d = dx * dx + dy * dy + dz * dz
    if LATER:
        d = tl.where((d > last) | ((d == last) & (j > last_who)), d, float("inf"))
    return d


@triton.jit
def _insert(d, j, d0, i0, d1, i1, d2, i2, d3, i3, KEPT: tl.constexpr):
    """Put a point behind those that are as near or nearer; the last falls out."""
    if KEPT > 3:
        d3, i3 = tl.where(d < d2, d2, tl.where(d < d3, d, d3)), tl.where(d < d2, i2, tl.where(d < d3, j, i3))
    if KEPT > 2:
        d2, i2 = tl.where(d < d1, d1, tl.where(d < d2, d, d2)), tl.where(d < d1, i1, tl.where(d < d2, j, i2))
    if KEPT > 1:
        d1, i1 = tl.where(d < d0, d0, tl.where(d < d1, d, d1)), tl.where(d < d0, i0, tl.where(d < d1, j, i1))
    return tl.where(d < d0, d, d0), tl.where(d < d0, j, i0), d1, i1, d2, i2, d3, i3


@triton.jit
def _write(index, square, who, d, own):
    """One column of the result."""
    tl.store(index, who.to(tl.int64), mask=own)
    tl.store(square, d, mask=own)
