"""PointNet (Qi et al. 2017): features of each point beside one of the whole cloud."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pnet.backbones.base import Backbone
from pnet.backbones.layers import RowBatchNorm, centred, shared_mlp
from pnet.ops.pyramid import Tables


class PointNet(Backbone):
    """The segmentation network without its transformation nets: a camera's clouds have one orientation.

    Args:
        local: channels of the MLP whose output stands for the point. wide: of the MLP before the maximum.
        merged: of the MLP on both. scale: unit of the centred points, metres.
    """

    def __init__(
        self, local: Sequence[int], wide: Sequence[int], merged: Sequence[int], scale: float
    ) -> None:
        super().__init__()
        self.features = merged[-1]
        self._scale = scale
        self.local = shared_mlp([3, *local])
        self.wide = shared_mlp([local[-1], *wide])
        # W [f; g] = W_f f + W_g g: the cloud's share is computed once
        self.of_point = nn.Linear(local[-1], merged[0], bias=False)
        self.of_cloud = nn.Linear(wide[-1], merged[0], bias=False)
        self.norm = RowBatchNorm(merged[0])
        self.merged = shared_mlp(merged)

    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """(B, N, 3) metres → (B, N, F); no tables."""
        own = self.local(centred(points) / self._scale)
        whole = self.wide(own).amax(1, keepdim=True)
        both = self.norm(self.of_point(own) + self.of_cloud(whole))
        features: Tensor = self.merged(torch.relu(both))
        return features
