"""Ball queries: the first k points, in index order, within a radius of each centre.

Points come in farthest-point-sampling order, so every stretch of them covers the whole cloud, and a search in
index order has k neighbours after some k / (share of the cloud in the ball) points, whatever N is: of a
scene's 16,384 points 340 for k = 32 and 30 mm, where the 27 cells of a grid hold 4,500. So the points are
simply tried in order. A centre with fewer than k neighbours tries all of them, which a large cloud makes
long: there a grid takes over what the first points did not settle.
"""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.buckets import coordinates
from pnet.ops.cuda.grid import SIDE_X, SIDE_Y, SIDE_Z, axis_cell, build_grid, run_of
from pnet.ops.cuda.launch import EXACT, block, on_device_of

CHUNK = 128  # points that a warp tries at a time
LARGE = 2**15  # points of a cloud for which a grid is made …
FIRST = 2**12  # … for centres that do not find enough among so many
MOST = 256  # neighbours that the grid's search keeps, at most
NONE = tl.constexpr(2**31 - 1)  # behind all numbers


def ball_query(points: Tensor, centres: Tensor, limit: float, k: int) -> Tensor:
    """First k in index order with a squared distance of at most `limit`; see `pnet.ops.neighbours`."""
    centres = centres.contiguous()
    B, m, _ = centres.shape
    n = points.shape[1]
    found = torch.empty(B, m, k, dtype=torch.int64, device=points.device)
    square = points.new_full((1,), limit)  # as a number, a kernel would get it in single precision
    axes = points.transpose(1, 2).contiguous()
    tried = min(n, FIRST) if n >= LARGE and k <= MOST else n
    with on_device_of(points):
        _scan[B * m,](
            axes, centres, square, found, n, m, tried, k, C=block(tried, CHUNK), num_warps=1, **EXACT
        )
        if tried < n:
            grid = build_grid(points.contiguous(), math.sqrt(limit))
            _from_grid[B * m,](
                *grid, axes, centres, square, found, n, m, k,
                C=CHUNK, K=max(32, triton.next_power_of_2(k)), num_warps=1, **EXACT,
            )  # fmt: skip
    return found


@triton.jit(do_not_specialize=["m", "k"])
def _scan(axes, centres, limit, found, n, m, tried, k, C: tl.constexpr):
    """One centre's row, from the first `tried` points; −1 in its last place where it is left to the grid."""
    row = tl.program_id(0).to(tl.int64)
    axes += row // m * n * 3
    found += row * k
    x, y, z = coordinates(centres + row * 3, 1)
    reach = tl.load(limit)
    held, first, at = 0, 0, 0
    while (held < k) & (at < tried):
        i = at + tl.arange(0, C)
        within = _distance(axes, i, tried, n, x, y, z) <= reach
        within = within & (i < tried)
        hits = tl.sum(within.to(tl.int32))
        if hits > 0:
            place = held + tl.cumsum(within.to(tl.int32)) - 1
            tl.store(found + place, i.to(tl.int64), mask=within & (place < k))
            if held == 0:
                first = tl.min(tl.where(within, i, NONE))
            held += hits
        at += C
    if held < k:
        if tried < n:
            tl.store(found + k - 1, tl.full((), -1, tl.int64))
        else:
            if held == 0:
                first = _nearest_one(axes, n, x, y, z, C)
            for at in range(held, k, C):
                place = at + tl.arange(0, C)
                tl.store(found + place, (first + tl.zeros((C,), tl.int32)).to(tl.int64), mask=place < k)


@triton.jit
def _distance(axes, i, stop, n, x, y, z):
    """Squared distances of points from a place."""
    dx = tl.load(axes + i, mask=i < stop, other=0.0) - x
    dy = tl.load(axes + n + i, mask=i < stop, other=0.0) - y
    dz = tl.load(axes + 2 * n + i, mask=i < stop, other=0.0) - z
    return dx * dx + dy * dy + dz * dz


@triton.jit
def _nearest_one(axes, n, x, y, z, C: tl.constexpr):
    """The nearest of all points; of equally near ones the first."""
    best = tl.full((C,), float("inf"), axes.dtype.element_ty)
    who = tl.zeros((C,), tl.int32)
    for at in range(0, n, C):
        i = at + tl.arange(0, C)
        square = _distance(axes, i, n, n, x, y, z)
        nearer = (square < best) & (i < n)
        best = tl.where(nearer, square, best)
        who = tl.where(nearer, i, who)
    return tl.min(tl.where(best == tl.min(best), who, NONE))


@triton.jit(do_not_specialize=["n", "m", "k"])
def _from_grid(
    place, number, start, low, inverse, axes, centres, limit, found, n, m, k,
    C: tl.constexpr, K: tl.constexpr,
):  # fmt: skip
    """One centre's row, where the scan left it, from the 27 cells around it: the k smallest numbers there."""
    row = tl.program_id(0).to(tl.int64)
    found += row * k
    if tl.load(found + k - 1) < 0:
        b = row // m
        x, y, z = coordinates(centres + row * 3, 1)
        reach = tl.load(limit)
        cell_x = axis_cell(x, tl.load(low + b * 3), tl.load(inverse + b * 3), SIDE_X)
        cell_y = axis_cell(y, tl.load(low + b * 3 + 1), tl.load(inverse + b * 3 + 1), SIDE_Y)
        cell_z = axis_cell(z, tl.load(low + b * 3 + 2), tl.load(inverse + b * 3 + 2), SIDE_Z)
        column = tl.arange(0, K)
        held = tl.where(column < k, NONE, -1)  # k places, filled in any order
        worst = tl.max(held)
        for r in range(9):
            first, last = run_of(start, b * (SIDE_X * SIDE_Y * SIDE_Z), cell_x, cell_y, cell_z, r)
            for at in range(first, last, C):
                new = _numbers_within(place, number, at + tl.arange(0, C), last, x, y, z, reach)
                least = tl.min(new)
                while least < worst:  # it takes the place of the worst, or of the first free one
                    held = tl.where(column == tl.min(tl.where(held == worst, column, K)), least, held)
                    worst = tl.max(held)
                    new = tl.where(new == least, NONE, new)
                    least = tl.min(new)
        held = tl.where(column < k, held, NONE)
        filler = tl.min(held)
        if filler == NONE:
            filler = _nearest_one(axes + b * n * 3, n, x, y, z, C)
        for s in range(k):
            least = tl.min(held)
            tl.store(found + s, tl.where(least < NONE, least, filler).to(tl.int64))
            held = tl.where(held == least, NONE, held)


@triton.jit
def _numbers_within(place, number, i, last, x, y, z, reach):
    """The numbers of the grid's rows `i` that lie within reach, NONE for the others."""
    px, py, pz = coordinates(place + tl.minimum(i, last - 1).to(tl.int64) * 3, 1)
    dx, dy, dz = px - x, py - y, pz - z
    within = (dx * dx + dy * dy + dz * dz <= reach) & (i < last)
    return tl.load(number + i, mask=within, other=NONE)
