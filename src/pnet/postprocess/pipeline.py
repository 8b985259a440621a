"""The whole right half of the paper's Fig. 5."""

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from pnet.parts.base import ParametricPart
from pnet.postprocess.batches import in_batches, sound_points
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.detections import LEFT_OUT, by_scene, no_detections, on_cpu
from pnet.postprocess.fit import fit_template
from pnet.postprocess.folded_vote import FoldedVote
from pnet.postprocess.grouping import Clusters, clusters_of
from pnet.postprocess.radius_filter import RadiusFilter
from pnet.postprocess.refinement import Refinement
from pnet.postprocess.score import instance_score, sure_enough
from pnet.postprocess.vote import InstanceVotes, PointVotes, Voting
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
        trust: keypoints are weighted in the fit by 1 / (s² + trust²), s² the square of the spread of their
            votes and that of the network's doubt together, `trust` the error of votes that agree, metres.
            None: equal weights, as equation 6 has it. Where a label is ambiguous (a flat ring seen along
            its axis has no nearest rim point) votes disagree and their mean is far from every equivalent;
            the weight keeps it from dragging the pose along.
        doubtful: an instance's score falls by a factor of e where its keypoints are expected to be off by
            this share of the largest distance of a keypoint from the centroid; None: it doesn't.
        refine: fits poses, or sizes too, to the cloud; None: they stay.
    """

    cluster: CentroidClusters
    radius_filter: RadiusFilter | None
    voting: Voting
    visibility_threshold: float
    scene_parameters: bool
    best_visible: float
    trust: float | None
    doubtful: float | None = None
    refine: Refinement | None = None

    def __post_init__(self) -> None:
        if self.doubtful is not None and self.doubtful <= 0:
            raise ValueError(f"postprocess.doubtful is {self.doubtful}, expected a positive share or null")

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

    def without_lookalikes(self) -> "PoseRecovery":
        """The same for a network whose labels were exchanged nowhere."""
        if not isinstance(self.voting, FoldedVote):
            return self
        return replace(self, voting=replace(self.voting, lookalikes=False))

    def _recover(
        self, part: ParametricPart, prediction: PointPrediction, points: Tensor | None
    ) -> list[Detections]:
        said = prediction.keypoints, prediction.visibility, prediction.doubt, prediction.parameters
        clusters = clusters_of(self.cluster(prediction.centroid, sound_points(*said)))
        if not len(clusters.groups):
            return [no_detections(part, len(own)) for own in clusters.owner]
        score = instance_score(prediction.visibility, clusters)
        agreed = self.voting(part, self._votes(prediction, clusters))
        parameters = self._sizes(part, agreed, score, clusters.scenes)
        template = part.chain.keypoints_from_parameters(parameters)
        sure = sure_enough(score, prediction.visibility, self.visibility_threshold)
        # the mark travels with the score: one transfer from the device less
        score = torch.where(sure, self._confidence(agreed, template, score), LEFT_OUT)
        R, t = fit_template(part.chain, template, agreed.centroid, agreed.keypoints, self._weight(agreed))
        found = on_cpu(Detections(R, t, parameters, score, agreed.keypoints, clusters.owner))
        if self.refine is not None and points is not None:
            found = self.refine.refined(part, found, points, clusters.scenes)
        return by_scene(found, found.score > LEFT_OUT, clusters.scenes)

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
        doubt, sizes = (
            None if said is None else clusters.of(said).double()
            for said in (prediction.doubt, prediction.parameters)
        )
        return PointVotes(centroid, keypoints, clusters.groups, reliable, doubt, sizes)

    def _weight(self, agreed: InstanceVotes) -> Tensor | None:
        """(d, 1 + m) of the centroid and the keypoints in the fit."""
        if self.trust is None:
            return None
        variance = agreed.spread.square() + self.trust**2
        if agreed.doubt is not None:
            variance = variance + agreed.doubt[:, : variance.shape[1]].square()
        return 1 / variance

    def _confidence(self, agreed: InstanceVotes, template: Tensor, score: Tensor) -> Tensor:
        """(d,) score, lower where the keypoints are expected to be off by much of the part's size."""
        if agreed.doubt is None or self.doubtful is None:
            return score
        size = torch.linalg.vector_norm(template, dim=-1).amax(-1)
        off = agreed.doubt[:, : agreed.spread.shape[1]].square().mean(-1).sqrt()
        return score * torch.exp(-off / (self.doubtful * size))

    def _sizes(self, part: ParametricPart, agreed: InstanceVotes, score: Tensor, scenes: list[int]) -> Tensor:
        """(d, k) the part's own where it has one size only, else those voted, each or by scene."""
        parameters = agreed.parameters
        if part.is_fixed:
            return torch.from_numpy(part.grids["L"][0]).to(parameters).expand_as(parameters).clone()
        if not self.scene_parameters:
            return parameters
        # small numbers, which the CPU adds up in the same order for any device
        doubt = (
            torch.ones_like(parameters) if agreed.doubt is None else agreed.doubt[:, 1 + len(part.chain) :]
        )
        known = zip(*(x.cpu().split(scenes) for x in (parameters, score, doubt)), strict=True)
        return torch.cat([self._shared(*own) for own in known]).to(parameters)

    def _shared(self, parameters: Tensor, score: Tensor, doubt: Tensor) -> Tensor:
        """(d, k) the mean parameters of one scene's best visible instances, for all; the surer count more."""
        if not len(score):
            return parameters
        best = score >= self.best_visible * score.max()
        weight = 1 / doubt[best].square()
        return ((weight * parameters[best]).sum(0) / weight.sum(0)).expand_as(parameters)
