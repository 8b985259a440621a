"""Farthest point sampling (Eldar et al. 1997)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnet.ops.operators import check_clouds, kernel, operator, squared_distance


def farthest_points(points: Tensor, count: int, start: int = 0) -> Tensor:
    """Indices of farthest point sampling: each next point is the one farthest from those before.

    The order is progressive: its first k indices are the k-point sample. Ties go to the smaller index.

    Args:
        points: (B, N, 3) metres. count: how many, at least 1. start: index of the first.
    Returns:
        (B, count) int64; where count > N all points come first and are then repeated in order.
    """
    check_clouds(points=points)
    if count < 1 or not 0 <= start < points.shape[1]:
        raise ValueError(f"cannot take {count} of {points.shape[1]} points from index {start} on")
    order: Tensor = _farthest_points(points.detach(), count, start)
    return order


def farthest_point_order(points: NDArray[np.floating], count: int, start: int = 0) -> NDArray[np.int64]:
    """The same for one numpy cloud (n, 3), in float32; (count,) indices."""
    cloud = torch.from_numpy(np.array(points, np.float32, ndmin=2))
    return farthest_points(cloud[None], count, start)[0].numpy()


@operator
def _farthest_points(points: Tensor, count: int, start: int) -> Tensor:
    """One pass over all points per choice."""
    B, n, _ = points.shape
    cloud, taken = torch.arange(B, device=points.device), min(count, n)
    order = torch.full((B, taken), start, device=points.device)
    gap = points.new_full((B, n), torch.inf)
    for i in range(1, taken):
        last = order[:, i - 1]
        gap = torch.minimum(gap, squared_distance(points, points[cloud, last][:, None]))
        gap[cloud, last] = -1.0  # so that it is not chosen again, not even where points coincide
        farthest = gap == gap.amax(1, keepdim=True)
        order[:, i] = torch.where(farthest, torch.arange(n, device=points.device), n).amin(1)
    return order[:, torch.arange(count, device=points.device) % taken]


@kernel(_farthest_points, "cpu")
def _(points: Tensor, count: int, start: int) -> Tensor:
    from pnet.ops.cpu import sampling as kernels

    return kernels.farthest_points(points.contiguous(), count, start)


@kernel(_farthest_points, "cuda")
def _(points: Tensor, count: int, start: int) -> Tensor:
    from pnet.ops.cuda import sampling as kernels

    return kernels.farthest_points(points, count, start)


@_farthest_points.register_fake
def _(points: Tensor, count: int, start: int) -> Tensor:
    return points.new_empty(points.shape[0], count, dtype=torch.int64)
