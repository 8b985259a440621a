"""Farthest point sampling: one dependent step a point, so that latency alone counts.

A cloud is one program; one of a usual size is one warp, whose reductions need no barrier. It keeps every
bucket's box, its largest gap (squared distance from the sample) and who has it; the gaps of all points stay
in memory, where a step touches those of the few buckets that are nearer to its point than their largest gap.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.buckets import Buckets, box_offset, build_buckets, coordinates, sortable
from pnet.ops.cuda.launch import EXACT, on_device_of

SIZE = 128  # places of a bucket, at least: four a thread, one load of 16 bytes for each array
ONE_WARP = 2**15  # points that one warp serves: more buckets would not fit its registers
BUCKETS, MANY_BUCKETS = 256, 1024  # at most: of one warp, of several
WARPS = 4  # for larger clouds


def farthest_points(points: Tensor, count: int, start: int) -> Tensor:
    """See `pnet.ops.sampling.farthest_points`."""
    points = points.contiguous()
    B, n, _ = points.shape
    warps, most = (1, BUCKETS) if n <= ONE_WARP else (WARPS, MANY_BUCKETS)
    size = max(SIZE, triton.next_power_of_2(n) // most)
    buckets = build_buckets(points, size)
    gap, far, who = _before_the_first(buckets, n, start)
    taken = min(count, n)
    order = torch.empty(B, taken, dtype=torch.int64, device=points.device)
    with on_device_of(points):
        _farthest_points[B,](
            points, *buckets, gap, far, who, order, n, taken, start,
            BUCKETS=far.shape[1], SIZE=size, num_warps=warps, **EXACT,
        )  # fmt: skip
    if count == taken:
        return order
    return order.index_select(1, torch.arange(count, device=points.device).remainder_(taken))


def _before_the_first(buckets: Buckets, n: int, start: int) -> tuple[Tensor, Tensor, Tensor]:
    """Gaps (B, S), and of each bucket (B, buckets) the largest and who has it: `start` in its own bucket."""
    B, _, count = buckets.low.shape
    number = buckets.number
    gap = torch.where(number < n, torch.inf, -1.0).to(buckets.place.dtype)  # a copy is never chosen
    who = torch.where(number == start, number - n, number).view(B, count, -1).amin(2)
    return gap, gap.view(B, count, -1).amax(2), torch.where(who < 0, who + n, who)


@triton.jit(do_not_specialize=["n", "count", "start"])
def _farthest_points(
    points, place, number, low, high, gap, far, who, order, n, count, start,
    BUCKETS: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """The order of one cloud."""
    b = tl.program_id(0).to(tl.int64)
    points += b * n * 3
    place += b * (3 * BUCKETS * SIZE)
    number += b * (BUCKETS * SIZE)
    gap += b * (BUCKETS * SIZE)
    order += b * count
    bucket = tl.arange(0, BUCKETS)
    x0, y0, z0 = coordinates(low + b * (3 * BUCKETS) + bucket, BUCKETS)
    x1, y1, z1 = coordinates(high + b * (3 * BUCKETS) + bucket, BUCKETS)
    largest = tl.load(far + b * BUCKETS + bucket)
    holder = tl.load(who + b * BUCKETS + bucket)
    chosen = start.to(tl.int32)
    for step in range(count):
        tl.store(order + step, chosen.to(tl.int64))
        x, y, z = coordinates(points + chosen.to(tl.int64) * 3, 1)
        # the point's own bucket comes first, so that its gaps arrive while the boxes are tried: whoever is
        # chosen is the holder of its bucket
        own = tl.min(tl.where(holder == chosen, bucket, BUCKETS))
        top, first = _visit(place, number, gap, own, chosen, x, y, z, n, BUCKETS * SIZE, SIZE)
        dx, dy, dz = box_offset(x0, x1, x), box_offset(y0, y1, y), box_offset(z0, z1, z)
        near = ((dx * dx + dy * dy + dz * dz) < largest) & (bucket != own)
        largest = tl.where(bucket == own, top, largest)
        holder = tl.where(bucket == own, first, holder)
        at = tl.min(tl.where(near, bucket, BUCKETS))
        while at < BUCKETS:
            top, first = _visit(place, number, gap, at, chosen, x, y, z, n, BUCKETS * SIZE, SIZE)
            largest = tl.where(bucket == at, top, largest)
            holder = tl.where(bucket == at, first, holder)
            near = near & (bucket > at)
            at = tl.min(tl.where(near, bucket, BUCKETS))
        best = sortable(largest)
        chosen = tl.min(tl.where(best == tl.max(best), holder, n))


@triton.jit
def _visit(place, number, gap, bucket, chosen, x, y, z, n, SLOTS: tl.constexpr, SIZE: tl.constexpr):
    """Update a bucket's gaps for the chosen point; the largest, and the smallest number that has it."""
    slot = bucket * SIZE + tl.arange(0, SIZE)
    px, py, pz = coordinates(place + slot, SLOTS)
    who = tl.load(number + slot)
    dx, dy, dz = px - x, py - y, pz - z
    # with several warps one may load what another has stored just now; the minimum is the same then
    left = tl.minimum(tl.load(gap + slot), dx * dx + dy * dy + dz * dz)
    left = tl.where(who == chosen, -1.0, left)  # not chosen again, not even where points coincide
    tl.store(gap + slot, left)
    tl.debug_barrier()  # a later step loads them; with one warp this costs next to nothing
    key = sortable(left)
    top = tl.max(key)
    return top.to(left.dtype, bitcast=True), tl.min(tl.where(key == top, who, n))
