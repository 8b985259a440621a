"""The grid: every point has one cell, and the nine runs around a place hold all that is near it."""

import numpy as np
import pytest
import torch
import triton
import triton.language as tl

from pnet.ops.cuda.grid import (
    CELLS,
    SIDE_X,
    SIDE_Y,
    SIDE_Z,
    SIDES,
    axis_cell,
    build_grid,
    run_of,
)
from pnet.ops.operators import squared, squared_distance


def extent(points):
    """A length of the cloud's size, without the stray point; 1 metre for a single place."""
    return float(points[:, :400].double().std()) or 1.0


@triton.jit
def _write_runs(queries, start, low, inverse, first, last, m, total, BLOCK: tl.constexpr):
    i = tl.minimum(tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), total - 1)
    b = (i // m).to(tl.int64)
    low, inverse, queries = low + b * 3, inverse + b * 3, queries + i * 3
    x = axis_cell(tl.load(queries), tl.load(low), tl.load(inverse), SIDE_X)
    y = axis_cell(tl.load(queries + 1), tl.load(low + 1), tl.load(inverse + 1), SIDE_Y)
    z = axis_cell(tl.load(queries + 2), tl.load(low + 2), tl.load(inverse + 2), SIDE_Z)
    for r in range(9):
        a, e = run_of(start, b * (SIDE_X * SIDE_Y * SIDE_Z), x, y, z, r)
        tl.store(first + r * total + i, a)
        tl.store(last + r * total + i, e)


def runs_around(grid, queries):
    """(9, B, M) first and last rows of the runs around queries (B, M, 3)."""
    B, m, _ = queries.shape
    first, last = torch.empty(2, 9, B, m, dtype=torch.int32, device=queries.device)
    _write_runs[triton.cdiv(B * m, 64),](
        queries.contiguous(), grid.start, grid.low, grid.inverse, first, last, m, B * m, BLOCK=64
    )
    return first.cpu().numpy(), last.cpu().numpy()


def times_seen(grid, queries):
    """(B, M, N) how often each point, by its number, is in the runs around each query."""
    B, n, _ = grid.place.shape
    first, last = runs_around(grid, queries)
    row = np.empty((B, n), np.int64)  # where each number stands
    np.put_along_axis(row, grid.number.cpu().numpy().astype(np.int64), np.arange(B * n).reshape(B, n), 1)
    row = row[:, None]
    return sum(
        ((a[..., None] <= row) & (row < e[..., None])).astype(int) for a, e in zip(first, last, strict=True)
    )


def test_every_point_stands_in_its_cell_and_in_order(here, clouds):
    B, n, _ = clouds.shape
    place, number, start, low, inverse = (t.cpu() for t in build_grid(here(clouds), 0.1 * extent(clouds)))
    assert number.dtype == start.dtype == torch.int32
    assert torch.equal(number.sort(1).values, torch.arange(n).int().expand(B, n))
    assert torch.equal(place, clouds.gather(1, number.long()[..., None].expand(-1, -1, 3)))
    assert start[0] == 0 and start[-1] == B * n and len(start) == B * CELLS + 1

    cells = (place - low[:, None]) * inverse[:, None]
    cells = torch.minimum(cells, torch.tensor(SIDES) - 1.0).long()
    x, y, z = cells.unbind(2)
    cell = (torch.arange(B)[:, None] * SIDES[2] + z) * SIDES[1] + y
    cell = (cell * SIDES[0] + x).flatten()
    assert torch.equal(cell, cell.sort().values)
    assert torch.equal(start.long(), torch.searchsorted(cell, torch.arange(len(start))))
    inside = cell[1:] == cell[:-1]
    assert bool((number.flatten()[1:] > number.flatten()[:-1])[inside].all())


@pytest.mark.parametrize("reach", [1e-6, 0.1, 1000.0])
def test_the_runs_hold_every_point_within_the_radius_once(here, clouds, reach):
    some, radius = clouds[:, :200], reach * extent(clouds)
    grid = build_grid(here(some), radius)
    spread = 1.5 * (some - some.mean(1, keepdim=True)) + some.mean(1, keepdim=True)
    queries = torch.cat([some[:, :20], some[:, -20:] + 0.7 * radius, spread[:, :20]], 1)
    near = squared_distance(some[:, None], queries[:, :, None]) <= squared(radius, some)
    seen = times_seen(grid, here(queries))
    assert seen.max() <= 1
    assert bool((seen[near.numpy()] == 1).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("origin", [0.0, 1000.0, -7e4])
def test_points_exactly_a_radius_apart_are_seen_wherever_the_cloud_lies(here, dtype, origin):
    radius = 0.25  # as wide as the cells, nearly
    end = torch.rand(3, 200, 3, generator=torch.Generator().manual_seed(0), dtype=dtype) + origin
    other = end + radius * torch.eye(3, dtype=dtype)[:, None]  # a cloud for each axis
    grid = build_grid(here(torch.cat([end, other], 1)), radius)
    near = squared_distance(other[:, None], end[:, :, None]) <= radius**2
    assert near.sum() > 2000
    assert bool((times_seen(grid, here(end))[..., 200:][near.numpy()] == 1).all())


def test_a_small_radius_on_a_wide_cloud_leaves_most_points_unseen(here):
    points = torch.rand(1, 500, 3, generator=torch.Generator().manual_seed(0))
    seen = times_seen(build_grid(here(points), 0.01), here(points))
    assert seen.sum() < 500 * 500 / 64


def test_a_radius_without_a_square_finds_coincident_points(here):
    points = torch.zeros(1, 5, 3)
    points[0, 3] = 1e-30  # the square of its distance is 0 in single precision
    grid = build_grid(here(points), 0.0)
    assert bool((times_seen(grid, here(points)) == 1).all())
