"""Voting modulo the part's symmetry: votes for different equivalents of a keypoint agree.

Under the rule `point` an instance's points are taught different equivalents on purpose; under `camera` they
disagree where two are nearly equally near. A mean over equivalents is none of them. Here every point's
keypoints make a hypothesis of the pose; the hypotheses are averaged modulo the symmetry group, and each
point's keypoints are then carried by a symmetry element to the template's own place, where votes differ by
their errors only.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pnet.geometry.constants import converted
from pnet.geometry.rigid import apply_inverse_pose, apply_pose
from pnet.geometry.rotation_mean import mean_rotation
from pnet.parts.base import ParametricPart
from pnet.parts.keypoints import KeypointChain
from pnet.postprocess.fit import fit_template
from pnet.postprocess.location import FLOOR, location, median
from pnet.postprocess.vote import InstanceVotes, PointVotes, vote, vote_spread


@dataclass(frozen=True)
class FoldedVote:
    """Robust voting modulo the symmetry; the radius filter serves the centroids.

    Attributes:
        hypotheses: the most points of a cluster whose poses are averaged; the first, so well spread ones.
        votes: the most points of a cluster that vote for keypoints and parameters.
        width: angle from the mean at which a hypothesis no longer counts, degrees.
        cut: distance from the location at which a vote no longer counts, in medians of that distance.
    """

    filters_keypoints: ClassVar[bool] = False

    hypotheses: int
    votes: int
    width: float
    cut: float

    def __call__(self, part: ParametricPart, votes: PointVotes) -> InstanceVotes:
        """Fold and average; parameters are measured between the folded keypoints."""
        chain, groups, kept = part.chain, votes.groups, votes.reliable[:, 0]
        centroid = vote(votes.centroid, groups, kept)
        member, valid = groups.first(self.votes)
        own_centroid, keypoints = votes.centroid[member], votes.keypoints[member]
        per_point = chain.parameters_from_keypoints(own_centroid, keypoints)
        template = chain.keypoints_from_parameters(location(per_point, valid, self.cut)[0])
        R = self._rotation(part, template, own_centroid, keypoints, valid)
        folded = fold(chain, template, apply_inverse_pose(R[:, None], centroid[:, None], keypoints))
        place, spread = self._locations(folded, valid)
        parameters = chain.parameters_from_keypoints(torch.zeros_like(centroid), place)
        own = vote_spread(votes.centroid, groups, centroid, kept)
        return InstanceVotes(
            centroid, apply_pose(R, centroid, place), parameters, torch.cat([own[:, None], spread], 1)
        )

    def _rotation(
        self, part: ParametricPart, template: Tensor, centroid: Tensor, keypoints: Tensor, valid: Tensor
    ) -> Tensor:
        """(d, 3, 3) part → camera, one of the equivalents, from the first points' own fits."""
        some = slice(0, self.hypotheses)
        centroid, keypoints, valid = centroid[:, some], keypoints[:, some], valid[:, some]
        R, t = fit_template(part.chain, template[:, None], centroid, keypoints)
        misfit = _misfit(part.chain, template[:, None], R, t, keypoints)
        usual = median(misfit, valid).clamp(min=FLOOR)
        weight = valid / (1 + (misfit / usual[:, None]).square())
        return mean_rotation(R, weight, part.symmetry, self.width * torch.pi / 180)

    def _locations(self, folded: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Of the keypoints (d, n, m, 3): (d, m, 3), and their spreads (d, m)."""
        d, n, m, _ = folded.shape
        values = folded.transpose(1, 2).reshape(d * m, n, 3)
        place, spread = location(values, valid[:, None].expand(d, m, n).reshape(d * m, n), self.cut)
        return place.view(d, m, 3), spread.view(d, m)


def fold(chain: KeypointChain, template: Tensor, local: Tensor) -> Tensor:
    """Carry each vote's keypoints by the symmetry element that brings them nearest to the template's.

    Args:
        chain: the part's keypoints. template: (d, m, 3) canonical keypoints, metres.
        local: (d, n, m, 3) votes carried into the part frame by the instance's pose, metres.
    Returns:
        (d, n, m, 3); free keypoints turned to the template's place on their circle.
    """
    G = converted(chain.group, local)
    if len(G) > 1 and any(chain.is_finite):
        images = _finite(chain, template)[:, None] @ G.mT  # (d, g, f, 3)
        # ‖vote − image‖² less what is the same for every element: only the products differ
        likeness = _finite(chain, local).flatten(-2) @ images.flatten(-2).mT
        local = local @ G[likeness.argmax(-1)]
    return chain.turn_back(local)


def _finite(chain: KeypointChain, keypoints: Tensor) -> Tensor:
    """Those of the keypoints (..., m, 3) that have finitely many equivalents, (..., f, 3)."""
    columns = zip(keypoints.unbind(-2), chain.is_finite, strict=True)
    return torch.stack([column for column, finite in columns if finite], -2)


def _misfit(chain: KeypointChain, template: Tensor, R: Tensor, t: Tensor, keypoints: Tensor) -> Tensor:
    """(...) root mean square distance of votes from the template (..., m, 3) at their own pose, metres."""
    local = apply_inverse_pose(R, t, keypoints)
    mirrors = [converted(M, local) for M in chain.chiralities]
    errors = [chain.place_like(template, local @ M) @ M.mT - local for M in mirrors]
    return torch.stack([error.square().sum(-1).mean(-1) for error in errors]).amin(0).sqrt()
