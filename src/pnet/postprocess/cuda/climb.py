"""Mean shift's searches on CUDA.

A seed is one program's, a warp that walks through the grid's cells around it until it has arrived. Its lanes
take the points by their place in memory, wherever a run of cells begins, so seeds that see the same points
get the very same mean.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.grid import SIDE_X, SIDE_Y, SIDE_Z, axis_cell, build_grid, run_of
from pnet.ops.cuda.launch import EXACT, block, on_device_of

LANES = 64  # points that a seed's program takes at once
POINTS = 128  # of a program that looks for their modes
WARP = {"num_warps": 1}


def climb(
    points: Tensor, counted: Tensor, seeds: Tensor, bandwidth: float, stop: float, steps: int
) -> tuple[Tensor, Tensor]:
    """See `pnet.postprocess.climb`."""
    B, s, _ = seeds.shape
    centres, intensity = seeds.new_empty(B, s, 3), seeds.new_empty(B, s)
    if seeds.numel():
        grid = build_grid(_out_of_reach(points, counted, bandwidth), bandwidth)
        with on_device_of(points):
            _climb[B * s,](
                grid.place, grid.start, grid.low, grid.inverse, seeds.contiguous(), centres, intensity,
                _numbers(points, bandwidth * bandwidth, stop), s, steps, LANES=LANES, **WARP, **EXACT,
            )  # fmt: skip
    return centres, intensity


def distinct(centres: Tensor, seen: Tensor, bandwidth: float) -> Tensor:
    """See `pnet.postprocess.climb`."""
    B, s = seen.shape
    stays = seen.new_empty(B, s)
    if stays.numel():
        size = triton.next_power_of_2(s)
        with on_device_of(centres):
            _distinct[B,](
                centres.contiguous(), seen.contiguous(), stays, _numbers(centres, bandwidth * bandwidth), s,
                S=size, num_warps=min(max(size // 256, 1), 8), **EXACT,
            )  # fmt: skip
    return stays


def nearest_mode(points: Tensor, modes: Tensor, number: Tensor, bandwidth: float) -> Tensor:
    """See `pnet.postprocess.climb`."""
    B, n, _ = points.shape
    labels = torch.empty(B, n, dtype=torch.int64, device=points.device)
    size = block(n, POINTS)
    if labels.numel():
        with on_device_of(points):
            _nearest_mode[triton.cdiv(n, size), B](
                points.contiguous(), modes.contiguous(), number.contiguous(), labels,
                _numbers(points, bandwidth * bandwidth), n, modes.shape[1], POINTS=size, **EXACT,
            )  # fmt: skip
    return labels


def _out_of_reach(points: Tensor, counted: Tensor, bandwidth: float) -> Tensor:
    """Points (B, N, 3), those that don't count where no seed comes: means stay among the points that do."""
    low = points.masked_fill(~counted[..., None], torch.inf).amin(1, keepdim=True)
    beside = torch.where(low.isfinite(), low, 0.0) - 2 * bandwidth
    return torch.where(counted[..., None], points, beside).contiguous()


def _numbers(like: Tensor, *values: float) -> Tensor:
    """Double precision, which a kernel's plain arguments lose; made where they are needed."""
    return torch.cat([like.new_full((1,), value) for value in values])


@triton.jit
def _climb(
    place, start, low, inverse, seeds, centres, intensity, limits, s, steps,
    LANES: tl.constexpr,
):  # fmt: skip
    """One seed's way. limits: the squared bandwidth and the shortest step."""
    seed = tl.program_id(0).to(tl.int64)
    b = seed // s
    reach, stop = tl.load(limits), tl.load(limits + 1)
    x, y, z = tl.load(seeds + seed * 3), tl.load(seeds + seed * 3 + 1), tl.load(seeds + seed * 3 + 2)
    count = tl.sum(tl.zeros((LANES,), tl.int32))
    left = tl.where(x == x, steps, 0)  # NaN is no seed
    while left > 0:
        count, to_x, to_y, to_z = _mean(place, start, low, inverse, b, x, y, z, reach, LANES)
        dx, dy, dz = to_x - x, to_y - y, to_z - z
        moved = tl.sqrt((dx * dx + dy * dy) + dz * dz) > stop
        left = tl.where(moved, left - 1, 0)
        x, y, z = to_x, to_y, to_z
    tl.store(centres + seed * 3, x)
    tl.store(centres + seed * 3 + 1, y)
    tl.store(centres + seed * 3 + 2, z)
    tl.store(intensity + seed, count.to(tl.float64))


@triton.jit
def _mean(place, start, low, inverse, b, x, y, z, reach, LANES: tl.constexpr):
    """How many points are around a place, and their mean; the place itself where there are none."""
    lane = tl.arange(0, LANES)
    low += b * 3  # each cloud has its own grid
    inverse += b * 3
    cell_x = axis_cell(x, tl.load(low), tl.load(inverse), SIDE_X)
    cell_y = axis_cell(y, tl.load(low + 1), tl.load(inverse + 1), SIDE_Y)
    cell_z = axis_cell(z, tl.load(low + 2), tl.load(inverse + 2), SIDE_Z)
    count = tl.zeros((LANES,), tl.int32)
    sum_x, sum_y, sum_z = (
        tl.zeros((LANES,), tl.float64),
        tl.zeros((LANES,), tl.float64),
        tl.zeros((LANES,), tl.float64),
    )
    for r in range(9):
        first, last = run_of(start, b * (SIDE_X * SIDE_Y * SIDE_Z), cell_x, cell_y, cell_z, r)
        for base in range(first // LANES * LANES, last, LANES):
            row = base + lane
            own = (row >= first) & (row < last)
            at = place + row.to(tl.int64) * 3
            px, py, pz = tl.load(at, own, 0.0), tl.load(at + 1, own, 0.0), tl.load(at + 2, own, 0.0)
            dx, dy, dz = px - x, py - y, pz - z
            near = own & ((dx * dx + dy * dy) + dz * dz <= reach)
            count += near.to(tl.int32)
            sum_x += tl.where(near, px, 0.0)
            sum_y += tl.where(near, py, 0.0)
            sum_z += tl.where(near, pz, 0.0)
    total = tl.sum(count)
    share = tl.maximum(total, 1).to(tl.float64)
    seen = total > 0
    mean_x = tl.where(seen, tl.sum(sum_x) / share, x)
    mean_y = tl.where(seen, tl.sum(sum_y) / share, y)
    mean_z = tl.where(seen, tl.sum(sum_z) / share, z)
    return total, mean_x, mean_y, mean_z


@triton.jit
def _distinct(centres, seen, stays, limits, s, S: tl.constexpr):
    """One scene: the first of those left stays and sends away all within reach, until none is left."""
    b = tl.program_id(0).to(tl.int64)
    lane = tl.arange(0, S)
    own = lane < s
    at = centres + (b * s + lane) * 3
    reach = tl.load(limits)
    left = tl.load(seen + b * s + lane, own, 0) != 0
    stay = lane < 0
    first = tl.min(tl.where(left, lane, S))
    while first < S:
        chosen = centres + (b * s + first) * 3
        dx = tl.load(at, own, 0.0) - tl.load(chosen)
        dy = tl.load(at + 1, own, 0.0) - tl.load(chosen + 1)
        dz = tl.load(at + 2, own, 0.0) - tl.load(chosen + 2)
        stay = stay | (lane == first)
        left = left & (lane > first) & ((dx * dx + dy * dy) + dz * dz > reach)
        first = tl.min(tl.where(left, lane, S))
    tl.store(stays + b * s + lane, stay, own)


@triton.jit
def _nearest_mode(points, modes, number, labels, limits, n, s, POINTS: tl.constexpr):
    i = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    own = i < n
    b = tl.program_id(1).to(tl.int64)
    at = points + (b * n + i) * 3
    x, y, z = tl.load(at, own, 0.0), tl.load(at + 1, own, 0.0), tl.load(at + 2, own, 0.0)
    best = tl.full((POINTS,), float("inf"), tl.float64)
    label = tl.full((POINTS,), -1, tl.int64)
    mode = modes + b * s * 3
    for m in range(tl.load(number + b).to(tl.int32)):
        dx, dy, dz = tl.load(mode + m * 3) - x, tl.load(mode + m * 3 + 1) - y, tl.load(mode + m * 3 + 2) - z
        square = (dx * dx + dy * dy) + dz * dz
        label = tl.where(square < best, m, label)
        best = tl.minimum(square, best)
    tl.store(labels + b * n + i, tl.where(best <= tl.load(limits), label, -1), own)
