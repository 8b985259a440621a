"""PPR-Net (Dong et al., IROS 2019), the baseline of the paper's tables: poses are regressed per point."""

from collections.abc import Sequence

import roma
import torch
from torch import Tensor, nn

from pnet.backbones.base import Backbone
from pnet.backbones.layers import shared_mlp
from pnet.models.heads import OffsetHead, VisibilityHead
from pnet.models.instance_pooling import pooling_of
from pnet.ops.pyramid import Tables
from pnet.records import PosePrediction


class PPRNet(nn.Module):
    """Backbone with three heads: centroid, rotation as Euler angles, visibility.

    Args:
        backbone: points to features. hidden: of the centroid and rotation heads. visibility_hidden: of the
            visibility head.
        keypoints, parameters, sizes, doubt: not used, the pose is regressed without any; every
            network is built with the same arguments, so that `method` alone exchanges them.
        scale: metres per unit of the centroid head's last layer. pooling: see `ParametricNet`.
        visibility: False leaves the visibility head out.
    """

    def __init__(
        self,
        backbone: Backbone,
        keypoints: int,
        hidden: Sequence[int],
        visibility_hidden: Sequence[int],
        scale: float,
        visibility: bool,
        parameters: int = 0,
        sizes: bool = False,
        doubt: bool = False,
        pooling: float | None = None,
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.centroid = OffsetHead(backbone.features, hidden, 1, scale)
        self.pooling = pooling_of(backbone.features, pooling, scale)
        self.rotation = RotationHead(backbone.features, hidden)
        self.visibility = VisibilityHead(backbone.features, visibility_hidden) if visibility else None

    def forward(self, points: Tensor, tables: Tables | None = None) -> PosePrediction:
        """Predict for every point.

        Args:
            points: (B, N, 3) camera frame, metres, in sampling order.
            tables: of the same points, or None to find them here.
        """
        if tables is None:
            tables = self.backbone.tables(points)
        features = self.backbone(points, tables)
        centroid = self.centroid(features, points).squeeze(-2)
        if self.pooling is not None:
            features = self.pooling(features, points, centroid)
        return PosePrediction(
            centroid=centroid,
            rotation=self.rotation(features),
            visibility=None if self.visibility is None else self.visibility(features),
        )


class RotationHead(nn.Module):
    """Regresses the rotation of a point's instance as three Euler angles.

    Args:
        features: F. hidden: sizes of the hidden layers.
    """

    def __init__(self, features: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.mlp = shared_mlp([features, *hidden])
        self.last = nn.Linear(hidden[-1], 3)

    def forward(self, features: Tensor) -> Tensor:
        """features (B, N, F) → (B, N, 3, 3) rotations, part → camera."""
        hidden: Tensor = self.mlp(features)
        # in bf16 an angle is half a degree off, and a product of turns is no rotation
        with torch.autocast(hidden.device.type, enabled=False):
            angles = self.last(hidden.float())
            R: Tensor = roma.euler_to_rotmat("XYZ", angles)  # intrinsic: Rx Ry Rz
        return R
