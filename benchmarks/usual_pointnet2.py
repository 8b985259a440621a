"""PointNet++ the way most PyTorch code has it: whole distance matrices, sorts, and a layer a neighbour."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from pnet.backbones.base import Backbone
from pnet.ops.pyramid import Tables


def pairwise_square(a: Tensor, b: Tensor) -> Tensor:
    """(B, M, 3), (B, N, 3) → (B, M, N) squared distances, as |a|² + |b|² − 2 a·b."""
    product = -2 * torch.matmul(a, b.transpose(1, 2))
    return product + a.square().sum(-1)[:, :, None] + b.square().sum(-1)[:, None]


def ball_query(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    """(B, M, k) the first k points within the radius; short rows are filled with their first."""
    n = points.shape[1]
    index = torch.arange(n, device=points.device).repeat(*centres.shape[:2], 1)
    index[pairwise_square(centres, points) > radius**2] = n
    index = index.sort(-1)[0][:, :, :k]
    first = index[:, :, :1].expand_as(index)
    return torch.where(index == n, first, index)


def three_nearest(points: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """(B, N, 3) indices into known and weights."""
    square, index = pairwise_square(points, known).sort(-1)
    weight = 1 / (square[:, :, :3] + 1e-8)
    return index[:, :, :3], weight / weight.sum(-1, keepdim=True)


def farthest_points(points: Tensor, count: int) -> Tensor:
    """(B, count) indices: one pass over all points per choice."""
    batch, n, _ = points.shape
    cloud = torch.arange(batch, device=points.device)
    order = torch.zeros(batch, count, dtype=torch.long, device=points.device)
    gap = torch.full((batch, n), 1e10, device=points.device)
    last = torch.zeros(batch, dtype=torch.long, device=points.device)
    for i in range(count):
        order[:, i] = last
        square = (points - points[cloud, last][:, None]).square().sum(-1)
        gap = torch.where(square < gap, square, gap)
        last = gap.max(-1)[1]
    return order


def take(rows: Tensor, index: Tensor) -> Tensor:
    """(B, n, C), (B, ...) → (B, ..., C)."""
    cloud = torch.arange(len(rows), device=rows.device).view(-1, *[1] * (index.ndim - 1)).expand_as(index)
    return rows[cloud, index]


def linear_of_neighbours(
    layer: nn.Linear, points: Tensor, features: Tensor, index: Tensor, radius: float, side: int = 1
) -> Tensor:
    """[(x_j − x_i) / radius; f_j] of every neighbour, `side` of them side by side, through one layer.

    Args:
        points: (B, n, 3); the first M are the centres. features: (B, n, C). index: (B, M, k).
    Returns:
        (B, M, k / side, after).
    """
    offset = (take(points, index) - points[:, : index.shape[1], None]) / radius
    pairs = torch.cat([offset, take(features, index)], -1)
    taken: Tensor = layer(pairs.unflatten(2, (-1, side)).flatten(3))
    return taken


class Abstraction(nn.Module):
    """Sample, group, 1 × 1 convolutions on every neighbour, maximum."""

    def __init__(
        self, points: int, radius: float, neighbours: int, features: int, mlp: Sequence[int]
    ) -> None:
        super().__init__()
        self._points, self._radius, self._neighbours = points, radius, neighbours
        layers = []
        for before, after in pairwise([3 + features, *mlp]):
            layers += [nn.Conv2d(before, after, 1), nn.BatchNorm2d(after), nn.ReLU()]
        self.mlp = nn.Sequential(*layers)

    def forward(self, points: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        """(B, n, 3), (B, n, C) or None → centres (B, M, 3) and (B, M, mlp[-1])."""
        centres = take(points, farthest_points(points, min(self._points, points.shape[1])))
        index = ball_query(points, centres, self._radius, self._neighbours)
        grouped = take(points, index) - centres[:, :, None]
        if features is not None:
            grouped = torch.cat([grouped, take(features, index)], -1)
        return centres, self.mlp(grouped.permute(0, 3, 2, 1)).amax(2).transpose(1, 2)


class Propagation(nn.Module):
    """Interpolate, concatenate, 1 × 1 convolutions."""

    def __init__(self, features: int, mlp: Sequence[int]) -> None:
        super().__init__()
        layers = []
        for before, after in pairwise([features, *mlp]):
            layers += [nn.Conv1d(before, after, 1), nn.BatchNorm1d(after), nn.ReLU()]
        self.mlp = nn.Sequential(*layers)

    def forward(self, points: Tensor, known: Tensor, skip: Tensor | None, coarse: Tensor) -> Tensor:
        """(B, n, 3), (B, M, 3), (B, n, S) or None, (B, M, C) → (B, n, mlp[-1])."""
        index, weight = three_nearest(points, known)
        spread = (take(coarse, index) * weight[..., None]).sum(2)
        both = spread if skip is None else torch.cat([skip, spread], -1)
        merged: Tensor = self.mlp(both.transpose(1, 2)).transpose(1, 2)
        return merged


class UsualPointNet2(Backbone):
    """Single-scale PointNet++; it samples and searches in its forward pass.

    Args:
        levels: points, radius, neighbours and mlp of each, finest first. propagation: coarsest first.
    """

    def __init__(
        self,
        levels: Sequence[tuple[int, float, int, Sequence[int]]],
        propagation: Sequence[Sequence[int]],
    ) -> None:
        super().__init__()
        self.abstraction, self.propagation = nn.ModuleList(), nn.ModuleList()
        widths = [0]
        for points, radius, neighbours, mlp in levels:
            self.abstraction.append(Abstraction(points, radius, neighbours, widths[-1], mlp))
            widths.append(mlp[-1])
        width = widths.pop()
        for mlp in propagation:
            self.propagation.append(Propagation(width + widths.pop(), mlp))
            width = mlp[-1]
        self.features = width

    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """(B, N, 3) metres → (B, N, F); no tables."""
        places, features = [points], [None]
        for step in self.abstraction:
            centres, encoded = step(places[-1], features[-1])
            places.append(centres)
            features.append(encoded)
        rising = features.pop()
        for step in self.propagation:
            known = places.pop()
            rising = step(places[-1], known, features.pop(), rising)
        return rising
