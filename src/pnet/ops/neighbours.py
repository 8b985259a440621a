"""Neighbour tables of point clouds (B, N, 3): indices only, so nothing here has a gradient.

All of them are exact and break ties by the smaller index, whatever kernel runs.
"""

import torch
from torch import Tensor

from pnet.ops.operators import check_clouds, kernel, operator, squared, squared_distance

CHUNK = 2**22  # distances that a reference holds at a time


def ball_query(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    """The first k points, in index order, within a radius of each centre (PointNet++).

    Args:
        points: (B, N, 3), centres: (B, M, 3) metres. radius: metres. k: neighbours.
    Returns:
        (B, M, k) int64; where fewer are found the first is repeated, where none the nearest point is.
    """
    check_clouds(points=points, centres=centres)
    found: Tensor = _ball_query(points.detach(), centres.detach(), squared(radius, points), _at_least_one(k))
    return found


def nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k nearest points of every query, the nearest first.

    Args:
        points: (B, N, 3), queries: (B, M, 3) metres. k: at most N.
    Returns:
        index (B, M, k) int64 and squared distance (B, M, k), square metres.
    """
    check_clouds(points=points, queries=queries)
    if k > points.shape[1]:
        raise ValueError(f"{k} nearest of {points.shape[1]} points are asked for")
    index, square = _nearest(points.detach(), queries.detach(), _at_least_one(k))
    return index, square


def three_nearest(points: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """The three nearest known points of every point, with inverse squared distances as weights (PointNet++).

    Args:
        points: (B, N, 3), known: (B, M, 3) metres, M >= 1.
    Returns:
        index (B, N, 3) int64 into known and weight (B, N, 3), each row summing to 1; with M < 3 fewer
        columns. A point on a known one (nearer than some 10 µm) takes it alone.
    """
    index, square = nearest(known, points, min(3, known.shape[1]))
    weight = 1 / (square + 1e-10)
    return index, weight / weight.sum(-1, keepdim=True)


def octants(points: Tensor, radius: float) -> Tensor:
    """The nearest other point in each of the eight octants around every point (PointSIFT).

    Octant 4 [dx > 0] + 2 [dy > 0] + [dz > 0] holds the points with those signs of the offset, so octants
    whose numbers are 2i and 2i + 1 differ along z alone.

    Args:
        points: (B, N, 3) metres. radius: metres.
    Returns:
        (B, N, 8) int64; the point itself where an octant has none within the radius.
    """
    check_clouds(points=points)
    found: Tensor = _octants(points.detach(), squared(radius, points))
    return found


@operator
def _ball_query(points: Tensor, centres: Tensor, limit: float, k: int) -> Tensor:
    return _by_chunks(lambda p, c: _ball_query_one(p, c, limit, k), points, centres)[0]


@operator
def _nearest(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    index, square = _by_chunks(lambda p, q: _nearest_one(p, q, k), points, queries)
    return index, square


@operator
def _octants(points: Tensor, limit: float) -> Tensor:
    n = points.shape[1]
    numbered = torch.arange(n, device=points.device).expand(len(points), n)
    return _by_chunks(lambda p, q, me: _octants_one(p, q, me, limit), points, points, numbered)[0]


@kernel(_ball_query, "cpu")
def _(points: Tensor, centres: Tensor, limit: float, k: int) -> Tensor:
    from pnet.ops.cpu import neighbours as kernels

    return kernels.ball_query(points.contiguous(), centres.contiguous(), limit, k)


@kernel(_nearest, "cpu")
def _(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    from pnet.ops.cpu import neighbours as kernels

    return kernels.nearest(points.contiguous(), queries.contiguous(), k)


@kernel(_octants, "cpu")
def _(points: Tensor, limit: float) -> Tensor:
    from pnet.ops.cpu import neighbours as kernels

    return kernels.octants(points.contiguous(), limit)


@kernel(_ball_query, "cuda")
def _(points: Tensor, centres: Tensor, limit: float, k: int) -> Tensor:
    from pnet.ops.cuda import neighbours as kernels

    return kernels.ball_query(points, centres, limit, k)


@kernel(_nearest, "cuda")
def _(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    from pnet.ops.cuda import nearest as kernels

    return kernels.nearest(points, queries, k)


@kernel(_octants, "cuda")
def _(points: Tensor, limit: float) -> Tensor:
    from pnet.ops.cuda import octants as kernels

    return kernels.octants(points, limit)


@_ball_query.register_fake
def _(points: Tensor, centres: Tensor, limit: float, k: int) -> Tensor:
    return points.new_empty(*centres.shape[:2], k, dtype=torch.int64)


@_nearest.register_fake
def _(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    shape = (*queries.shape[:2], k)
    return points.new_empty(shape, dtype=torch.int64), points.new_empty(shape)


@_octants.register_fake
def _(points: Tensor, limit: float) -> Tensor:
    return points.new_empty(*points.shape[:2], 8, dtype=torch.int64)


def _at_least_one(k: int) -> int:
    if k < 1:
        raise ValueError(f"{k} neighbours are asked for, expected at least 1")
    return k


def _by_chunks(search, points: Tensor, *rows: Tensor) -> list[Tensor]:  # type: ignore[no-untyped-def]
    """search(points of a cloud, some of its rows, …) over all clouds and rows, put together."""
    size = max(1, CHUNK // points.shape[1])
    clouds = []
    for cloud, *own in zip(points, *rows, strict=True):
        parts = [search(cloud, *some) for some in zip(*(r.split(size) for r in own), strict=True)]
        parts = [part if isinstance(part, tuple) else (part,) for part in parts]
        clouds.append([torch.cat(column) for column in zip(*parts, strict=True)])
    return [torch.stack(column) for column in zip(*clouds, strict=True)]


def _ball_query_one(points: Tensor, centres: Tensor, limit: float, k: int) -> Tensor:
    n = len(points)
    square = squared_distance(points, centres[:, None])
    within = square <= limit
    # the key keeps index order among the points within, and puts the others behind
    key = torch.where(within, torch.arange(n, device=points.device), n)
    first = key.topk(min(k, n), dim=1, largest=False, sorted=True).values
    fallback = torch.where(within.any(1), first[:, 0], _smallest(square))[:, None]
    index = torch.where(first < n, first, fallback)
    return torch.cat([index, fallback.expand(-1, k - index.shape[1])], 1)


def _nearest_one(points: Tensor, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
    # a stable sort keeps index order among equal distances; topk does not promise it
    square, index = squared_distance(points, queries[:, None]).sort(dim=1, stable=True)
    return index[:, :k], square[:, :k]


def _octants_one(points: Tensor, queries: Tensor, me: Tensor, limit: float) -> Tensor:
    square = squared_distance(points, queries[:, None])
    near = (square <= limit) & (torch.arange(len(points), device=points.device) != me[:, None])
    positive = (points - queries[:, None]) > 0
    octant = 4 * positive[..., 0] + 2 * positive[..., 1] + 1 * positive[..., 2]
    columns = []
    for o in range(8):
        gap = torch.where(near & (octant == o), square, torch.inf)
        columns.append(torch.where(gap.isfinite().any(1), _smallest(gap), me))
    return torch.stack(columns, 1)


def _smallest(values: Tensor) -> Tensor:
    """(n, m) → (n,) the first index of the smallest entry; argmin does not promise the first."""
    index = torch.arange(values.shape[1], device=values.device)
    return torch.where(values == values.amin(1, keepdim=True), index, values.shape[1]).amin(1)
