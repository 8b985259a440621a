"""PPR-Net's post-processing: the poses that a cluster's points predict are averaged."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from pnet.geometry.rigid import apply_pose
from pnet.geometry.rotation_mean import mean_rotation
from pnet.parts.base import ParametricPart
from pnet.postprocess.batches import in_batches, sound_points
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.detections import LEFT_OUT, by_scene, no_detections, on_cpu
from pnet.postprocess.grouping import clusters_of
from pnet.postprocess.refinement import Refinement
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
        refine: fits poses, or sizes too, to the cloud; None: they stay.
    """

    cluster: CentroidClusters
    visibility_threshold: float
    votes: int
    width: float
    refine: Refinement | None = None

    def __call__(
        self, part: ParametricPart, prediction: PosePrediction, points: Tensor | None = None
    ) -> list[Detections]:
        """Recover the instances of every scene of a batch.

        Args:
            part: the template. prediction: of B scenes; one with a rotation that is no number has none.
            points: (B, N, 3) the scenes' clouds, camera frame, metres; for `refine`.
        """
        if self.refine is not None and points is None:
            raise ValueError("postprocess.refine needs the scenes' points")
        return in_batches(partial(self._recover, part), prediction, points)

    def _recover(
        self, part: ParametricPart, prediction: PosePrediction, points: Tensor | None
    ) -> list[Detections]:
        clusters = clusters_of(self.cluster(prediction.centroid, self._seen(prediction)))
        groups = clusters.groups
        if not len(groups):
            return [no_detections(part, len(own)) for own in clusters.owner]
        t = vote(clusters.of(prediction.centroid).double(), groups)
        member, valid = groups.first(self.votes)
        rotations = clusters.of(prediction.rotation).double()[member]
        R = mean_rotation(rotations, valid.double(), part.symmetry, math.radians(self.width))
        parameters = known_parameters(part, len(groups))
        unknown = t.new_full((len(groups), len(part.chain), 3), math.nan)
        score = instance_score(prediction.visibility, clusters)
        sure = sure_enough(score, prediction.visibility, self.visibility_threshold)
        marked = torch.where(sure, score, LEFT_OUT)
        found = on_cpu(Detections(R, t, parameters.to(t), marked, unknown, clusters.owner))
        if self.refine is not None and points is not None:
            found = self.refine.refined(part, found, points, clusters.scenes)
        known = ~found.parameters.isnan().any(1)
        if bool(known.any()):  # parts need not bear NaN
            places = part.chain.keypoints_from_parameters(found.parameters[known])
            found.keypoints[known] = apply_pose(found.R[known], found.t[known], places)
        return by_scene(found, found.score > LEFT_OUT, clusters.scenes)

    def _seen(self, prediction: PosePrediction) -> Tensor:
        """(B, N) bool, which points count: those that are visible enough."""
        sound = sound_points(prediction.rotation)
        if prediction.visibility is None:
            return sound
        return sound & (prediction.visibility.double() >= self.visibility_threshold)


def known_parameters(part: ParametricPart, d: int) -> Tensor:
    """(d, k) metres: the part's own where there is but one part object, in all its grids, else NaN."""
    size = np.full(part.k, math.nan) if part.only_size is None else part.only_size
    return torch.from_numpy(size).expand(d, -1).clone()
