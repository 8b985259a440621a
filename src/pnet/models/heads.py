"""Per-point regression heads."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pnet.backbones.layers import shared_mlp


class OffsetHead(nn.Module):
    """Regresses offsets from every point to q targets of its instance (M_C with q = 1, M_KP with q = m).

    Args:
        features: F. hidden: sizes of the hidden layers. targets: q.
        scale: metres per unit of the last layer; 1 is the paper's.
    """

    def __init__(self, features: int, hidden: Sequence[int], targets: int, scale: float) -> None:
        super().__init__()
        self._targets, self._scale = targets, scale
        self.mlp = shared_mlp([features, *hidden])
        self.last = nn.Linear(hidden[-1], 3 * targets)

    def forward(self, features: Tensor, points: Tensor) -> Tensor:
        """features (B, N, F), points (B, N, 3) metres → (B, N, q, 3) metres: point plus offset."""
        offset = self.last(self.mlp(features)).float().unflatten(-1, (self._targets, 3))
        return points[..., None, :] + self._scale * offset


class VisibilityHead(nn.Module):
    """Regresses the visibility of a point's instance (M_V).

    Args:
        features: F. hidden: sizes of the hidden layers.
    """

    def __init__(self, features: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.mlp = shared_mlp([features, *hidden])
        self.last = nn.Linear(hidden[-1], 1)

    def forward(self, features: Tensor) -> Tensor:
        """features (B, N, F) → (B, N) in [0, 1]."""
        return torch.sigmoid(self.last(self.mlp(features)).float()).squeeze(-1)
