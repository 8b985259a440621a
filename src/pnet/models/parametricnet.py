"""ParametricNet (Fig. 5 of the paper, left half): what is learnt per point."""

from collections.abc import Sequence

from torch import Tensor, nn

from pnet.backbones.base import Backbone
from pnet.models.heads import OffsetHead, VisibilityHead
from pnet.ops.pyramid import Tables
from pnet.records import PointPrediction


class ParametricNet(nn.Module):
    """Backbone with the modules M_C, M_KP and M_V; M_P and M_F need no weights.

    Args:
        backbone: points to features. keypoints: m of the part.
        hidden: of the offset heads. visibility_hidden: of M_V.
        scale: metres per unit of the offset heads' last layer.
        visibility: False leaves M_V out (the ablation "w/o M_V").
    """

    def __init__(
        self,
        backbone: Backbone,
        keypoints: int,
        hidden: Sequence[int],
        visibility_hidden: Sequence[int],
        scale: float,
        visibility: bool,
    ) -> None:
        super().__init__()
        self.backbone = backbone
        self.centroid = OffsetHead(backbone.features, hidden, 1, scale)
        self.keypoints = OffsetHead(backbone.features, hidden, keypoints, scale)
        self.visibility = VisibilityHead(backbone.features, visibility_hidden) if visibility else None

    def forward(self, points: Tensor, tables: Tables | None = None) -> PointPrediction:
        """Predict for every point.

        Args:
            points: (B, N, 3) camera frame, metres, in sampling order.
            tables: of the same points, or None to find them here.
        """
        if tables is None:
            tables = self.backbone.tables(points)
        features = self.backbone(points, tables)
        return PointPrediction(
            centroid=self.centroid(features, points).squeeze(-2),
            keypoints=self.keypoints(features, points),
            visibility=None if self.visibility is None else self.visibility(features),
        )
