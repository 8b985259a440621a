"""PointNet++ (Qi et al. 2017), single-scale grouping, as the group behind the paper configures it."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pnet.backbones.base import Backbone, Tables
from pnet.backbones.layers import gather_rows, shared_mlp
from pnet.ops.neighbours import ball_query, three_nearest


@dataclass(frozen=True)
class Level:
    """One set abstraction: centres, radius in metres, neighbours, channels of its MLP."""

    points: int
    radius: float
    neighbours: int
    mlp: Sequence[int]


class PointNet2(Backbone):
    """Set abstraction down, feature propagation up.

    Stored points are in sampling order, so every level is a prefix of the cloud: nothing is sampled here.

    Args:
        levels: finest first. propagation: channels of the MLPs on the way up, coarsest first.
        radius_scale: multiplies every radius, for parts of another size.
    """

    def __init__(
        self,
        levels: Sequence[Level],
        propagation: Sequence[Sequence[int]],
        radius_scale: float = 1.0,
    ) -> None:
        super().__init__()
        if len(levels) != len(propagation):
            raise ValueError(
                f"backbone: {len(levels)} levels need as many propagation MLPs, got {len(propagation)}"
            )
        self._levels, self._radius_scale = list(levels), radius_scale
        self.min_points = max(level.points for level in levels)
        self.features = propagation[-1][-1]
        widths = [0, *(level.mlp[-1] for level in levels)]
        self.abstraction = nn.ModuleList(
            shared_mlp([width + 3, *level.mlp]) for width, level in zip(widths[:-1], levels, strict=True)
        )
        ups, width = [], widths[-1]
        for skip, mlp in zip(widths[-2::-1], propagation, strict=True):
            ups.append(shared_mlp([width + skip, *mlp]))
            width = mlp[-1]
        self.propagation = nn.ModuleList(ups)

    def tables(self, points: Tensor) -> Tables:
        """ball_i (B, M_i, k) of level i; near_i and weight_i (B, M_{i-1}, 3) for the way up."""
        tables = {}
        with torch.no_grad():
            fine = points
            for i, level in enumerate(self._levels):
                coarse = fine[:, : level.points]
                radius = level.radius * self._radius_scale
                tables[f"ball_{i}"] = ball_query(fine, coarse, radius, level.neighbours)
                tables[f"near_{i}"], tables[f"weight_{i}"] = three_nearest(fine, coarse)
                fine = coarse
        return tables

    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """Down by grouping and max, up by interpolation and skip connections."""
        features: list[Tensor | None] = [None]
        fine = points
        for i, (level, mlp) in enumerate(zip(self._levels, self.abstraction, strict=True)):
            coarse = fine[:, : level.points]
            grouped = self._group(fine, coarse, features[-1], tables[f"ball_{i}"], level)
            features.append(mlp(grouped).amax(2))
            fine = coarse
        rising = features.pop()
        assert rising is not None
        for i, mlp in zip(reversed(range(len(self._levels))), self.propagation, strict=True):
            near, weight = tables[f"near_{i}"], tables[f"weight_{i}"]
            spread = (gather_rows(rising, near) * weight[..., None].to(rising)).sum(2)
            skip = features.pop()
            rising = mlp(spread if skip is None else torch.cat([spread, skip], -1))
        return rising

    def _group(
        self,
        fine: Tensor,
        coarse: Tensor,
        features: Tensor | None,
        ball: Tensor,
        level: Level,
    ) -> Tensor:
        """(B, M, k, 3 + C): relative places in units of the radius, and features."""
        offset = gather_rows(fine, ball) - coarse[:, :, None]
        offset = offset / (level.radius * self._radius_scale)
        if features is None:
            return offset
        return torch.cat([offset.to(features), gather_rows(features, ball)], -1)
