"""Neighbour tables of all levels of a backbone, from a plain specification.

They depend on the points alone: found once a scene, outside autograd, by a data loader's workers or by the
network itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.ops.neighbours import ball_query, octants, three_nearest

Tables = dict[str, Tensor]  # what depends on geometry alone: neighbour indices, cells, weights


@dataclass(frozen=True)
class Ball:
    """Ball queries around the centres of a level. radius: metres. neighbours: k."""

    radius: float
    neighbours: int


@dataclass(frozen=True)
class Pyramid:
    """Levels of a cloud in sampling order: every level is a prefix of the one below it.

    Attributes:
        sizes: points of levels 1, 2, …; level 0 is the whole cloud. A smaller cloud has smaller levels.
        balls: for levels 1, 2, …: what to look for in the level below.
        octants: for levels 0, 1, …: radius of the octant search in metres, or None for none.
    """

    sizes: Sequence[int]
    balls: Sequence[Sequence[Ball]]
    octants: Sequence[float | None]

    def __call__(self, points: Tensor) -> Tables:
        """Tables of clouds.

        Args:
            points: (B, N, 3) metres, in farthest-point-sampling order.
        Returns:
            ball_{i}_{s} (B, M_i, k): scale s of level i, into level i − 1; near_{i} and weight_{i}
            (B, M_{i−1}, 3): of level i − 1 into level i, for interpolation; octants_{i} (B, M_i, 8).
        """
        with torch.no_grad():
            tables, fine = {}, points
            for i in range(len(self.sizes) + 1):
                if i > 0:
                    coarse = fine[:, : self.sizes[i - 1]]
                    for s, ball in enumerate(self.balls[i - 1]):
                        tables[f"ball_{i}_{s}"] = ball_query(fine, coarse, ball.radius, ball.neighbours)
                    tables[f"near_{i}"], tables[f"weight_{i}"] = three_nearest(fine, coarse)
                    fine = coarse
                radius = self.octants[i] if i < len(self.octants) else None
                if radius is not None:
                    tables[f"octants_{i}"] = octants(fine, radius)
            return tables
