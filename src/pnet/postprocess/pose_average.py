"""PPR-Net's post-processing: the poses that a cluster's points predict are averaged."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pnet.geometry.rigid import apply_pose
from pnet.geometry.rotation_mean import mean_rotation
from pnet.parts.base import ParametricPart
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.folded_vote import members
from pnet.postprocess.icp import IcpRefinement
from pnet.postprocess.pipeline import best_first, no_detections
from pnet.postprocess.score import instance_score, sure_enough
from pnet.postprocess.vote import vote
from pnet.records import Detections, PosePrediction


@dataclass(frozen=True)
class PoseAveraging:
    """Point-wise poses → instances with pose and score.

    Rotations are brought to one representative of the part's symmetry before they are averaged (by the
    quaternions' chordal mean), which the released code leaves out. Nothing is known of a size: parameters are
    those of the part where it has one part object only, else NaN.

    Attributes:
        cluster: instance segmentation.
        visibility_threshold: points, and instances, with a lower visibility are left out.
        votes: the most points of a cluster whose rotations are averaged.
        width: angle from the mean at which a rotation no longer counts, degrees; 180: all count.
        refine: ICP against the cloud, or None.
    """

    cluster: CentroidClusters
    visibility_threshold: float
    votes: int
    width: float
    refine: IcpRefinement | None = None

    def __call__(
        self, part: ParametricPart, prediction: PosePrediction, scene: int, points: Tensor | None = None
    ) -> Detections:
        """Recover the instances of one scene of a batch.

        Args:
            part: the template. prediction: of a batch. scene: index into the batch.
            points: (N, 3) the scene's cloud, camera frame, metres; for `refine`.
        """
        centroids, rotations = (
            value[scene].cpu().double() for value in (prediction.centroid, prediction.rotation)
        )
        visibility = None if prediction.visibility is None else prediction.visibility[scene].cpu().double()
        labels = self._segment(centroids, visibility)
        d = int(labels.max()) + 1 if len(labels) else 0
        if d == 0 or not bool(torch.isfinite(rotations).all()):
            return no_detections(part, len(labels))
        t = vote(centroids, labels, labels >= 0, d)
        member, valid = members(labels, d, self.votes)
        R = mean_rotation(rotations[member], valid.double(), part.symmetry, math.radians(self.width))
        parameters = known_parameters(part, d)
        if self.refine is not None:
            if points is None:
                raise ValueError("postprocess.refine needs the scene's points")
            R, t = self.refine(part, parameters, R, t, points.cpu().double(), labels)
        score = instance_score(visibility, labels, d)
        found = Detections(R, t, parameters, score, _keypoints(part, parameters, R, t), labels)
        return best_first(found, sure_enough(score, visibility, self.visibility_threshold))

    def _segment(self, centroids: Tensor, visibility: Tensor | None) -> Tensor:
        """(N,) cluster, −1 for none: of the points that are visible enough."""
        if visibility is None:
            return self.cluster(centroids)
        seen = visibility >= self.visibility_threshold
        labels = torch.full((len(centroids),), -1)
        labels[seen] = self.cluster(centroids[seen])
        return labels


def known_parameters(part: ParametricPart, d: int) -> Tensor:
    """(d, k) metres: the part's own where there is but one part object, in all its grids, else NaN."""
    grid = torch.from_numpy(np.concatenate(list(part.grids.values())))
    row = grid[0] if bool((grid == grid[0]).all()) else torch.full_like(grid[0], math.nan)
    return row.expand(d, -1).clone()


def _keypoints(part: ParametricPart, parameters: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """(d, m, 3) camera frame, metres; NaN without parameters: parts need not bear NaN."""
    if bool(parameters.isnan().any()):
        return torch.full((len(R), len(part.chain), 3), math.nan, dtype=torch.float64)
    return apply_pose(R, t, part.chain.keypoints_from_parameters(parameters))
