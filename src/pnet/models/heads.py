"""Per-point regression heads."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pnet.backbones.layers import shared_mlp

LARGEST_LOGARITHM = 6.9  # natural, of a factor of 1,000


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


class SizeHead(nn.Module):
    """Regresses the parameters of a point's part object.

    Args:
        features: F. hidden: sizes of the hidden layers. parameters: k. scale: metres per unit.
    """

    def __init__(self, features: int, hidden: Sequence[int], parameters: int, scale: float) -> None:
        super().__init__()
        self._scale = scale
        self.mlp = shared_mlp([features, *hidden])
        self.last = nn.Linear(hidden[-1], parameters)

    def forward(self, features: Tensor) -> Tensor:
        """features (B, N, F) → (B, N, k) metres."""
        sizes: Tensor = self._scale * self.last(self.mlp(features)).float()
        return sizes


class DoubtHead(nn.Module):
    """Regresses how far off the other heads are.

    Args:
        features: F. hidden: sizes of the hidden layers. targets: how many lengths are judged.
        scale: metres that it starts from.
    """

    def __init__(self, features: int, hidden: Sequence[int], targets: int, scale: float) -> None:
        super().__init__()
        self._scale = scale
        self.mlp = shared_mlp([features, *hidden])
        self.last = nn.Linear(hidden[-1], targets)

    def forward(self, features: Tensor) -> Tensor:
        """features (B, N, F) → (B, N, targets) metres, within a factor of 1,000 of `scale`."""
        logarithm = self.last(self.mlp(features)).float()
        return self._scale * logarithm.clamp(-LARGEST_LOGARITHM, LARGEST_LOGARITHM).exp()


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
