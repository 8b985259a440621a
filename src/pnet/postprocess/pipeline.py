"""The whole right half of the paper's Fig. 5."""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from pnet.parts.base import ParametricPart
from pnet.postprocess.batches import in_batches, sound_points
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.detections import by_scene, no_detections, on_cpu
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.grouping import Clusters, clusters_of
from pnet.postprocess.icp import IcpRefinement, refined
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
        self, part: ParametricPart, prediction: PointPrediction, points: Tensor | None = None
    ) -> list[Detections]:
        """Recover the instances of every scene of a batch.

        Args:
            part: the template. prediction: of B scenes; one that says what is no number has no instances.
            points: (B, N, 3) the scenes' clouds, camera frame, metres; for `refine`.
        """
        if self.refine is not None and points is None:
            raise ValueError("postprocess.refine needs the scenes' points")
        return in_batches(partial(self._recover, part), prediction, points)

    def _recover(
        self, part: ParametricPart, prediction: PointPrediction, points: Tensor | None
    ) -> list[Detections]:
        said = prediction.keypoints, prediction.visibility
        clusters = clusters_of(self.cluster(prediction.centroid, sound_points(*said)))
        if not len(clusters.groups):
            return [no_detections(part, len(own)) for own in clusters.owner]
        score = instance_score(prediction.visibility, clusters)
        agreed = self.voting(part, self._votes(prediction, clusters))
        parameters = self._sizes(part, agreed.parameters, score, clusters.scenes)
        weight = None if self.trust is None else 1 / (agreed.spread.square() + self.trust**2)
        R, t = fit_pose(part.chain, parameters, agreed.centroid, agreed.keypoints, weight)
        found = on_cpu(Detections(R, t, parameters, score, agreed.keypoints, clusters.owner))
        if self.refine is not None and points is not None:
            found = refined(self.refine, part, found, points)
        sure = sure_enough(found.score, prediction.visibility, self.visibility_threshold)
        return by_scene(found, sure, clusters.scenes)

    def _votes(self, prediction: PointPrediction, clusters: Clusters) -> PointVotes:
        """What the clustered points say, and whose word the radius filter takes."""
        centroid, keypoints = (
            clusters.of(said).double() for said in (prediction.centroid, prediction.keypoints)
        )
        places = centroid[:, None]
        if self.voting.filters_keypoints:
            places = torch.cat([places, keypoints], 1)
        if self.radius_filter is None:
            reliable = torch.ones_like(places[..., 0], dtype=torch.bool)
        else:
            reliable = self.radius_filter(places, clusters.groups)
        return PointVotes(centroid, keypoints, clusters.groups, reliable)

    def _sizes(self, part: ParametricPart, parameters: Tensor, score: Tensor, scenes: list[int]) -> Tensor:
        """(d, k) the part's own where it has one size only, else those voted, each or by scene."""
        if part.is_fixed:
            return torch.from_numpy(part.grids["L"][0]).to(parameters).expand_as(parameters).clone()
        if not self.scene_parameters:
            return parameters
        # small numbers, which the CPU adds up in the same order for any device
        known = zip(*(x.split(scenes) for x in (parameters.cpu(), score.cpu())), strict=True)
        return torch.cat([self._shared(*own) for own in known]).to(parameters)

    def _shared(self, parameters: Tensor, score: Tensor) -> Tensor:
        """(d, k) the mean parameters of one scene's best visible instances, for all."""
        if not len(score):
            return parameters
        best = score >= self.best_visible * score.max()
        return parameters[best].mean(0).expand_as(parameters)
