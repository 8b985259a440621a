"""Farthest point sampling."""

import numpy as np
from numpy.typing import NDArray


def farthest_point_order(points: NDArray[np.floating], count: int) -> NDArray[np.int64]:
    """Indices of farthest point sampling (Eldar et al. 1997).

    The order is progressive: its first k indices are the k-point sample. The library counts the start
    in its tree's order, so which point comes first is the tree's choice: the same for equal clouds.

    Args:
        points: (n, 3), n >= 1, finite. count: how many, at least 1.
    Returns:
        (count,) indices; where count > n all points come first and are then repeated in order.
    """
    import fpsample

    n = len(points)
    if n == 0:
        raise ValueError("farthest point sampling needs at least one point")
    if not np.isfinite(points).all():
        raise ValueError("farthest point sampling got NaN or infinite coordinates")
    taken = min(count, n)
    if n == 1:
        order = np.zeros(1, np.int64)
    else:
        height = int(np.clip(np.log2(n / 64), 1, 9))  # buckets of about 64 points
        cloud = np.ascontiguousarray(points, np.float32)
        order = fpsample.bucket_fps_kdline_sampling(cloud, taken, h=height, start_idx=0)
    return np.resize(order.astype(np.int64), count)


def farthest_point_order_plain(points: NDArray[np.floating], count: int, start: int = 0) -> NDArray[np.int64]:
    """The plain twin of `farthest_point_order`, from a given start: one pass over all points per choice."""
    cloud = np.asarray(points, np.float32)
    taken = min(count, len(cloud))
    order = np.full(taken, start, np.int64)
    nearest = np.full(len(cloud), np.inf, np.float32)
    for i in range(1, taken):
        nearest = np.minimum(nearest, ((cloud - cloud[order[i - 1]]) ** 2).sum(1))
        order[i] = nearest.argmax()
    return np.resize(order, count)
