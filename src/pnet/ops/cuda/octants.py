"""The nearest point in each octant around every point.

A program of one warp serves one point. It tries its own bucket first, then those whose boxes may hold, in
some octant, a point as near as the best found there: of a scene's 16,384 points some 600, where the 27 cells
of a grid as wide as a network's first radius (30 mm) hold 4,500.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.buckets import box_offset, build_buckets, coordinates, sortable
from pnet.ops.cuda.launch import EXACT, block, on_device_of

SIZE = 32  # places of a bucket: one a thread
GROUP = 32  # buckets of a group, whose boxes are tried together; groups of a turn, likewise


def octants(points: Tensor, limit: float) -> Tensor:
    """Nearest in each octant with a squared distance of at most `limit`; see `pnet.ops.neighbours`."""
    B, n, _ = points.shape
    buckets = build_buckets(points, SIZE)
    count = buckets.low.shape[2]
    group = block(count, GROUP)
    found = torch.empty(B, n, 8, dtype=torch.int64, device=points.device)
    # a distance beyond all numbers is no distance; and as a number, a kernel would get it in single precision
    square = points.new_full((1,), min(limit, torch.finfo(points.dtype).max))
    with on_device_of(points):
        _octants[B * count * SIZE,](
            *buckets, buckets.low.view(B, 3, -1, group).amin(3), buckets.high.view(B, 3, -1, group).amax(3),
            square, found, n,
            BUCKETS=count, SIZE=SIZE, GROUP=group, num_warps=1, **EXACT,
        )  # fmt: skip
    return found


@triton.jit(do_not_specialize=["n"])
def _octants(
    place, number, low, high, group_low, group_high, limit, found, n,
    BUCKETS: tl.constexpr, SIZE: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    """The eight of one point, in the order of the buckets: programs that run together read the same."""
    SLOTS: tl.constexpr = BUCKETS * SIZE
    GROUPS: tl.constexpr = BUCKETS // GROUP
    slot = tl.program_id(0) % SLOTS
    b = (tl.program_id(0) // SLOTS).to(tl.int64)
    place += b * (3 * SLOTS)
    number += b * SLOTS
    low += b * (3 * BUCKETS)
    high += b * (3 * BUCKETS)
    group_low += b * (3 * GROUPS)
    group_high += b * (3 * GROUPS)
    me = tl.load(number + slot)
    x, y, z = coordinates(place + slot, SLOTS)
    # blocks have two axes everywhere, octants and candidates: so none has to be laid out anew
    best = tl.full((8, 1), 0, tl.int32) + sortable(tl.where(me < n, tl.load(limit), -1.0))  # a copy: nothing
    who = tl.full((8, 1), 0, tl.int32) + n
    own = slot // SIZE
    best, who = _visit(place, number, own, me, x, y, z, best, who, n, SLOTS, SIZE)
    for first in range(0, GROUPS, GROUP):
        turn = first + tl.arange(0, GROUP)[None, :]  # groups in turn, from its own on
        group = (own // GROUP + turn) % GROUPS
        opens = _serves(group_low + group, group_high + group, x, y, z, best, GROUPS) & (turn < GROUPS)
        next_turn = tl.min(tl.where(opens, turn, GROUPS))
        while next_turn < GROUPS:
            bucket = (own // GROUP + next_turn) % GROUPS * GROUP + tl.arange(0, GROUP)[None, :]
            serves = _serves(low + bucket, high + bucket, x, y, z, best, BUCKETS) & (bucket != own)
            at = tl.min(tl.where(serves, bucket, BUCKETS))
            while at < BUCKETS:
                best, who = _visit(place, number, at, me, x, y, z, best, who, n, SLOTS, SIZE)
                serves = serves & (bucket > at)
                at = tl.min(tl.where(serves, bucket, BUCKETS))
            opens = opens & (turn > next_turn)
            next_turn = tl.min(tl.where(opens, turn, GROUPS))
    row = found + (b * n + me) * 8 + tl.arange(0, 8)[:, None]
    tl.store(row, tl.where(who < n, who, me).to(tl.int64), mask=me < n)


@triton.jit
def _visit(place, number, bucket, me, x, y, z, best, who, n, SLOTS: tl.constexpr, SIZE: tl.constexpr):
    """Take a bucket's points into the nearest of each octant: smaller distance, then smaller number."""
    slot = bucket * SIZE + tl.arange(0, SIZE)[None, :]
    px, py, pz = coordinates(place + slot, SLOTS)
    other = tl.load(number + slot)
    dx, dy, dz = px - x, py - y, pz - z
    octant = 4 * (dx > 0).to(tl.int32) + 2 * (dy > 0).to(tl.int32) + (dz > 0).to(tl.int32)
    octant = tl.where((other != me) & (other < n), octant, 8)
    square = tl.where(octant == tl.arange(0, 8)[:, None], dx * dx + dy * dy + dz * dz, float("inf"))
    square = sortable(square)
    least = tl.minimum(best, tl.min(square, 1, keep_dims=True))
    first = tl.min(tl.where(square == least, other, n), 1, keep_dims=True)
    return least, tl.where(least < best, first, tl.minimum(who, first))


@triton.jit
def _serves(low, high, x, y, z, best, STEP: tl.constexpr):
    """Which boxes may hold, in some octant, a point as near as the best found there."""
    x0, y0, z0 = coordinates(low, STEP)
    x1, y1, z1 = coordinates(high, STEP)
    octant = tl.arange(0, 8)[:, None]
    dx = _side(x0, x1, x, octant & 4)
    dy = _side(y0, y1, y, octant & 2)
    dz = _side(z0, z1, z, octant & 1)
    may = sortable(dx * dx + dy * dy + dz * dz) <= best
    return tl.max(may.to(tl.int32), 0, keep_dims=True) > 0


@triton.jit
def _side(low, high, x, positive):
    """Least offset of what boxes hold on either side of a coordinate: infinite where they hold nothing."""
    offset = box_offset(low, high, x)
    above = tl.where(high > x, offset, float("inf"))
    below = tl.where(low <= x, offset, float("inf"))
    return tl.where(positive != 0, above, below)
