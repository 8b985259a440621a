"""A uniform grid of each cloud: whatever lies within a radius of a place is in the 27 cells around it.

Built without the host's knowing anything of the points, so the number of cells is fixed and their size is
what adapts. Cells that follow each other along x follow each other in memory, so that the 27 are nine runs.
"""

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.launch import on_device_of

SIDE_X, SIDE_Y, SIDE_Z = tl.constexpr(64), tl.constexpr(64), tl.constexpr(32)  # clouds of a camera are flat
SIDES = (SIDE_X.value, SIDE_Y.value, SIDE_Z.value)
CELLS = SIDES[0] * SIDES[1] * SIDES[2]  # of a cloud

# A cell is wider than the radius by a share that covers all rounding. Along an axis, two places that a kernel
# finds within the radius are at most radius · (1 + 4ε) apart, ε = 2⁻²⁴ in single precision. Subtracting `low`
# and multiplying by `inverse` err by a share of 2ε of the result, wherever the cloud lies, and the result is
# at most some 65 cells for a place that matters, so two of them err by less than 65 · 4ε < 2 · 10⁻⁵ cells.
# They are hence less than 1 cell apart, and their whole parts at most 1. Clamping to the grid moves them only
# towards each other: no query outside the box loses a neighbour.
MARGIN = 1e-4
# Squares of shorter offsets are lost in single precision: 0 ≤ 0 would hold for points that are apart.
LEAST = 1e-18  # metres
BLOCK = 256  # points of a program


class Grid(NamedTuple):
    """Clouds in the order of their cells; of a cell's points in the order of their numbers.

    Cell (x, y, z) of cloud b is number b · CELLS + (z · SIDE_Y + y) · SIDE_X + x.

    Attributes:
        place: (B, N, 3) points, metres. number: (B, N) int32 where each stood in its cloud.
        start: (B · CELLS + 1,) int32: cell c holds rows start[c] … start[c + 1] − 1 of all clouds' B · N.
        low: (B, 3) the corner of cell 0, metres. inverse: (B, 3) cells per metre.
    """

    place: Tensor
    number: Tensor
    start: Tensor
    low: Tensor
    inverse: Tensor


def build_grid(points: Tensor, radius: float) -> Grid:
    """The grid of clouds.

    Args:
        points: (B, N, 3) metres, B · N below 2³¹. radius: metres, of the searches in it, at most.
    """
    points = points.contiguous()
    B, n, _ = points.shape
    low, high = points.aminmax(dim=1)
    width = high - low
    for axis, side in enumerate(SIDES):
        width[:, axis] /= side
    inverse = width.clamp_(min=max(radius, LEAST) * (1 + MARGIN)).reciprocal_()
    wide = torch.int32 if B * CELLS < 2**31 else torch.int64
    cell = torch.empty(B * n, dtype=wide, device=points.device)
    with on_device_of(points):
        _cells[triton.cdiv(B * n, BLOCK),](points, low, inverse, cell, n, B * n, BLOCK=BLOCK)
    cell, order = cell.sort(stable=True)
    every = torch.arange(B * CELLS + 1, dtype=wide, device=points.device)
    return Grid(
        place=points.view(-1, 3).index_select(0, order).view(B, n, 3),
        number=order.remainder_(n).int().view(B, n),
        start=torch.searchsorted(cell, every, out_int32=True),
        low=low,
        inverse=inverse,
    )


@triton.jit
def axis_cell(place, low, inverse, SIDE: tl.constexpr):
    """The cell of places along one axis, 0 … SIDE − 1; that of the nearest end for places outside, 0 for NaN.

    Args:
        place: coordinates, metres. low, inverse: the grid's, for this cloud and axis. SIDE: SIDE_X, _Y or _Z.
    """
    cells = (place - low) * inverse
    return tl.minimum(tl.maximum(cells, 0.0), SIDE - 1.0).to(tl.int32)


@triton.jit
def run_of(start, base, x, y, z, r):
    """Rows (first, last) of the r-th of the nine runs of cells around a cell: first … last − 1.

    Args:
        start: the grid's. base: b · CELLS, int64, of a cloud that is there. x, y, z: the cell, int32.
        r: 0 … 8.
    Returns:
        int32; equal where there are none, as beyond the grid's border.
    """
    v, w = y + r % 3 - 1, z + r // 3 - 1
    inside = (v >= 0) & (v < SIDE_Y) & (w >= 0) & (w < SIDE_Z)
    row = start + base + (w * SIDE_Y + v) * SIDE_X
    first = tl.load(row + tl.maximum(x - 1, 0), mask=inside, other=0)
    last = tl.load(row + tl.minimum(x + 2, SIDE_X), mask=inside, other=0)
    return first, last


@triton.jit(do_not_specialize=["n", "total"])
def _cells(points, low, inverse, cell, n, total, BLOCK: tl.constexpr):
    """The number of the cell of each point."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    own = i < total
    b = i // n
    place, corner, scale = points + i * 3, low + b * 3, inverse + b * 3
    x = axis_cell(tl.load(place, own), tl.load(corner, own), tl.load(scale, own), SIDE_X)
    y = axis_cell(tl.load(place + 1, own), tl.load(corner + 1, own), tl.load(scale + 1, own), SIDE_Y)
    z = axis_cell(tl.load(place + 2, own), tl.load(corner + 2, own), tl.load(scale + 2, own), SIDE_Z)
    number = b * (SIDE_X * SIDE_Y * SIDE_Z) + (z * SIDE_Y + y) * SIDE_X + x
    tl.store(cell + i, number.to(cell.dtype.element_ty), own)
