"""The whole right half of the paper's Fig. 5, one scene at a time."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.parts.base import ParametricPart
from pnet.parts.keypoints import KeypointChain
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.radius_filter import RadiusFilter
from pnet.postprocess.vote import vote, vote_spread
from pnet.records import Detections, PointPrediction


@dataclass(frozen=True)
class PoseRecovery:
    """Point-wise predictions → instances with pose, parameters and score.

    Attributes:
        cluster: instance segmentation. radius_filter: None is the ablation "w/o RF".
        visibility_threshold: T_v; instances with a lower voted visibility are left out (with M_V only).
        scene_parameters: average the parameters over the scene's best visible instances, as the released
            code does: right where a scene holds one part object. best_visible: those whose visibility
            exceeds this share of the scene's highest.
        trust: keypoints are weighted in the fit by 1 / (s² + trust²), s the spread of their votes and
            `trust` the error of votes that agree, metres. None: equal weights, as equation 6 has it. Where
            a label is ambiguous (a flat ring seen along its axis has no nearest rim point) votes disagree
            and their mean is far from every equivalent; the weight keeps it from dragging the pose along.
    """

    cluster: CentroidClusters
    radius_filter: RadiusFilter | None
    visibility_threshold: float
    scene_parameters: bool
    best_visible: float
    trust: float | None

    def __call__(self, part: ParametricPart, prediction: PointPrediction, scene: int) -> Detections:
        """Recover the instances of one scene of a batch.

        Args:
            part: the template. prediction: of a batch. scene: index into the batch.
        """
        centroids = prediction.centroid[scene].cpu().double()
        keypoints = prediction.keypoints[scene].cpu().double()
        labels = self.cluster(centroids)
        d = int(labels.max()) + 1 if len(labels) else 0
        if d == 0:
            return no_detections(part, len(labels))
        visibility = self._score(prediction, scene, labels, d)
        targets = torch.cat([centroids[:, None], keypoints], 1)
        votes, weight = self._vote_all(targets, labels, d)
        parameters = self._parameters(part.chain, centroids, keypoints, labels, visibility)
        R, t = fit_pose(part.chain, part.mirror, parameters, votes[:, 0], votes[:, 1:], weight)
        found = Detections(R, t, parameters, visibility, votes[:, 1:], labels)
        # without M_V nothing is known of visibility, so nothing is left out for it
        threshold = self.visibility_threshold if prediction.visibility is not None else 0.0
        return best_first(found, visibility >= threshold)

    def _vote_all(self, targets: Tensor, labels: Tensor, d: int) -> tuple[Tensor, Tensor | None]:
        """Voted centroid and keypoints (d, 1 + m, 3), and their weights in the fit (d, 1 + m)."""
        voted, spread = [], []
        for values in targets.unbind(1):
            kept = self._reliable(values, labels)
            voted.append(vote(values, labels, kept, d))
            spread.append(vote_spread(values, labels, kept, voted[-1]))
        if self.trust is None:
            return torch.stack(voted, 1), None
        return torch.stack(voted, 1), 1 / (torch.stack(spread, 1).square() + self.trust**2)

    def _reliable(self, votes: Tensor, labels: Tensor) -> Tensor:
        return labels >= 0 if self.radius_filter is None else self.radius_filter(votes, labels)

    def _score(self, prediction: PointPrediction, scene: int, labels: Tensor, d: int) -> Tensor:
        """(d,) voted visibility; without M_V each cluster's number of points over the largest."""
        if prediction.visibility is not None:
            return vote(prediction.visibility[scene].cpu().double(), labels, labels >= 0, d)
        size = torch.bincount(labels[labels >= 0], minlength=d).double()
        return size / size.max()

    def _parameters(
        self,
        chain: KeypointChain,
        centroids: Tensor,
        keypoints: Tensor,
        labels: Tensor,
        visibility: Tensor,
    ) -> Tensor:
        """(d, k) module M_P: parameters of every point, voted per instance, metres."""
        per_point = chain.parameters_from_keypoints(centroids, keypoints)
        parameters = vote(per_point, labels, labels >= 0, len(visibility))
        if self.scene_parameters:
            best = visibility >= self.best_visible * visibility.max()
            parameters = parameters[best].mean(0).expand_as(parameters).clone()
        return parameters


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
