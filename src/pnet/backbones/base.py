"""The protocol that every backbone satisfies."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

Tables = dict[str, Tensor]  # what depends on geometry alone: neighbour indices, cells, weights


class Backbone(nn.Module, ABC):
    """Per-point features of a cloud.

    Attributes:
        features: F, channels of the output. min_points: fewest points of a cloud.
    """

    features: int
    min_points: int = 1

    @abstractmethod
    def tables(self, points: Tensor) -> Tables:
        """Neighbour tables of clouds; found once, outside autograd.

        Args:
            points: (B, N, 3) metres, camera frame, in farthest-point-sampling order.
        """

    @abstractmethod
    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """Features of every point.

        Args:
            points: (B, N, 3) metres. tables: of the same points.
        Returns:
            (B, N, F).
        """

    def check(self, points: int) -> None:
        """Raise ValueError where a cloud of so many points is too small for this backbone."""
        if points < self.min_points:
            raise ValueError(
                f"{type(self).__name__} needs clouds of at least {self.min_points} points, got {points}; "
                "raise data.points or choose smaller levels in the backbone's config"
            )
