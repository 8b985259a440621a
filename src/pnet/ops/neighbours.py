"""Neighbour tables of point clouds: plain torch, any device; found outside autograd."""

import torch
from torch import Tensor

CHUNK = 2**22  # distances held at a time


def ball_query(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    """The first k points, in index order, within a radius of each centre (PointNet++).

    Args:
        points: (B, N, 3), centres: (B, M, 3) metres. radius: metres. k: neighbours.
    Returns:
        (B, M, k) int64; where fewer are found the first is repeated, where none the nearest point is.
    """
    return torch.stack([_ball_query_one(p, c, radius, k) for p, c in zip(points, centres, strict=True)])


def three_nearest(points: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """The three nearest known points of every point, and their inverse-distance weights (PointNet++).

    Args:
        points: (B, N, 3), known: (B, M, 3) metres, M >= 1.
    Returns:
        index (B, N, 3) int64 into known and weight (B, N, 3), each row summing to 1; with M < 3 fewer
        columns.
    """
    tables = [_nearest_one(p, q, min(3, known.shape[1])) for p, q in zip(points, known, strict=True)]
    index, distance = (torch.stack(column) for column in zip(*tables, strict=True))
    weight = 1 / (distance.square() + 1e-10)
    return index, weight / weight.sum(-1, keepdim=True)


def _ball_query_one(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    n = len(points)
    found = []
    for some in centres.split(max(1, CHUNK // n)):
        distance = torch.cdist(some, points, compute_mode="donot_use_mm_for_euclid_dist")
        within = distance <= radius
        # the key keeps index order among the points within, and puts the others behind
        key = torch.where(within, torch.arange(n, device=points.device), n)
        first = key.topk(min(k, n), dim=1, largest=False, sorted=True).values
        fallback = torch.where(within.any(1), first[:, 0], distance.argmin(1))[:, None]
        index = torch.where(first < n, first, fallback)
        found.append(torch.cat([index, fallback.expand(-1, k - index.shape[1])], 1))
    return torch.cat(found)


def _nearest_one(points: Tensor, known: Tensor, k: int) -> tuple[Tensor, Tensor]:
    nearest = [
        torch.cdist(some, known, compute_mode="donot_use_mm_for_euclid_dist").topk(k, 1, largest=False)
        for some in points.split(max(1, CHUNK // len(known)))
    ]
    return torch.cat([n.indices for n in nearest]), torch.cat([n.values for n in nearest])
