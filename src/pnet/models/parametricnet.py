"""ParametricNet (Fig. 5 of the paper, left half): what is learnt per point."""

from collections.abc import Sequence

from torch import Tensor, nn

from pnet.backbones.base import Backbone
from pnet.models.heads import DoubtHead, OffsetHead, SizeHead, VisibilityHead
from pnet.models.instance_pooling import pooling_of
from pnet.ops.pyramid import Tables
from pnet.records import PointPrediction

TYPICAL_ERROR = 0.002  # metres: where the head of doubt starts


class ParametricNet(nn.Module):
    """Backbone with the modules M_C, M_KP and M_V; M_P and M_F need no weights.

    Args:
        backbone: points to features. keypoints: m of the part.
        hidden: of the offset heads. visibility_hidden: of M_V.
        scale: metres per unit of the offset heads' last layer.
        visibility: False leaves M_V out (the ablation "w/o M_V").
        parameters: k of the part, for two heads that the paper does not have:
        sizes: a head that learns the parameters as such. Between keypoints they are measured too short where
            a point is in two minds about a keypoint and says the middle.
        doubt: a head that learns how far off centroid, keypoints and parameters are.
        pooling: width of the cells in which `InstancePooling` lets the points of an instance share what they
            see, metres; None: they don't, as in the paper.
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
        self.keypoints = OffsetHead(backbone.features, hidden, keypoints, scale)
        self.visibility = VisibilityHead(backbone.features, visibility_hidden) if visibility else None
        self.sizes = SizeHead(backbone.features, visibility_hidden, parameters, scale) if sizes else None
        judged = 1 + keypoints + parameters
        self.doubt = DoubtHead(backbone.features, visibility_hidden, judged, TYPICAL_ERROR) if doubt else None

    def forward(self, points: Tensor, tables: Tables | None = None) -> PointPrediction:
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
        return PointPrediction(
            centroid=centroid,
            keypoints=self.keypoints(features, points),
            visibility=None if self.visibility is None else self.visibility(features),
            doubt=None if self.doubt is None else self.doubt(features),
            parameters=None if self.sizes is None else self.sizes(features),
        )
