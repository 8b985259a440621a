"""The whole right half of the paper's Fig. 5, one scene at a time."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.parts.base import ParametricPart
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.icp import IcpRefinement
from pnet.postprocess.radius_filter import RadiusFilter
from pnet.postprocess.score import instance_score, sure_enough
from pnet.postprocess.vote import PointVotes, Voting
from pnet.records import Detections, PointPrediction


@dataclass(frozen=True)
class PoseRecovery:
    """Point-wise predictions → instances with pose, parameters and score.

    Attributes:
        cluster: instance segmentation. radius_filter: None is the ablation "w/o RF".
        voting: how the votes of a cluster are brought together.
        visibility_threshold: T_v; instances with a lower voted visibility are left out (with M_V only).
        scene_parameters: average the parameters over the scene's best visible instances, as the released
            code does: right where a scene holds one part object. best_visible: those whose visibility
            exceeds this share of the scene's highest.
        trust: keypoints are weighted in the fit by 1 / (s² + trust²), s the spread of their votes and
            `trust` the error of votes that agree, metres. None: equal weights, as equation 6 has it. Where
            a label is ambiguous (a flat ring seen along its axis has no nearest rim point) votes disagree
            and their mean is far from every equivalent; the weight keeps it from dragging the pose along.
        refine: ICP against the cloud, or None.
    """

    cluster: CentroidClusters
    radius_filter: RadiusFilter | None
    voting: Voting
    visibility_threshold: float
    scene_parameters: bool
    best_visible: float
    trust: float | None
    refine: IcpRefinement | None = None

    def __call__(
        self, part: ParametricPart, prediction: PointPrediction, scene: int, points: Tensor | None = None
    ) -> Detections:
        """Recover the instances of one scene of a batch.

        Args:
            part: the template. prediction: of a batch. scene: index into the batch.
            points: (N, 3) the scene's cloud, camera frame, metres; for `refine`.
        """
        centroids = prediction.centroid[scene].cpu().double()
        keypoints = prediction.keypoints[scene].cpu().double()
        labels = self.cluster(centroids)
        if not bool(torch.isfinite(keypoints).all()):  # a network that has diverged finds nothing
            labels = torch.full_like(labels, -1)
        d = int(labels.max()) + 1 if len(labels) else 0
        if d == 0:
            return no_detections(part, len(labels))
        visibility = None if prediction.visibility is None else prediction.visibility[scene]
        score = instance_score(visibility, labels, d)
        votes = PointVotes(centroids, keypoints, labels, d, self._reliable(centroids, keypoints, labels))
        agreed = self.voting(part, votes)
        parameters = self._share(agreed.parameters, score)
        if part.is_fixed:
            parameters = torch.from_numpy(part.grids["L"][0]).expand_as(parameters).clone()
        weight = None if self.trust is None else 1 / (agreed.spread.square() + self.trust**2)
        R, t = fit_pose(part.chain, parameters, agreed.centroid, agreed.keypoints, weight)
        if self.refine is not None:
            if points is None:
                raise ValueError("postprocess.refine needs the scene's points")
            R, t = self.refine(part, parameters, R, t, points.cpu().double(), labels)
        found = Detections(R, t, parameters, score, agreed.keypoints, labels)
        return best_first(found, sure_enough(score, visibility, self.visibility_threshold))

    def _reliable(self, centroids: Tensor, keypoints: Tensor, labels: Tensor) -> Tensor:
        """(N, 1 + m) or (N, 1) which votes count: those in a cluster that the radius filter keeps."""
        places = centroids[:, None]
        if self.voting.filters_keypoints:
            places = torch.cat([places, keypoints], 1)
        if self.radius_filter is None:
            return (labels >= 0)[:, None].expand(-1, places.shape[1])
        return torch.stack([self.radius_filter(votes, labels) for votes in places.unbind(1)], 1)

    def _share(self, parameters: Tensor, score: Tensor) -> Tensor:
        """(d, k) parameters, those of a scene's best visible instances for all if `scene_parameters`."""
        if not self.scene_parameters:
            return parameters
        best = score >= self.best_visible * score.max()
        return parameters[best].mean(0).expand_as(parameters).clone()


def best_first(found: Detections, keep: Tensor) -> Detections:
    """The kept detections by falling score; their points' cluster numbers follow, others become −1."""
    order = torch.argsort(found.score, descending=True, stable=True)
    order = order[keep[order]]
    place = torch.full((len(keep) + 1,), -1)  # the last entry serves label −1
    place[order] = torch.arange(len(order))
    return Detections(
        found.R[order],
        found.t[order],
        found.parameters[order],
        found.score[order],
        found.keypoints[order],
        place[found.instance],
    )


def no_detections(part: ParametricPart, points: int) -> Detections:
    """Nothing found in a scene of so many points."""
    empty = torch.zeros(0, 3, 3, dtype=torch.float64)
    return Detections(
        R=empty,
        t=empty[:, 0],
        parameters=torch.zeros(0, part.k, dtype=torch.float64),
        score=torch.zeros(0, dtype=torch.float64),
        keypoints=torch.zeros(0, len(part.chain), 3, dtype=torch.float64),
        instance=torch.full((points,), -1),
    )
