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

from pnet.geometry.rigid import apply_inverse_pose, apply_pose
from pnet.geometry.rotation_mean import mean_rotation
from pnet.parts.base import ParametricPart
from pnet.parts.keypoints import KeypointChain
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.vote import InstanceVotes, PointVotes, vote, vote_spread

FLOOR = 1e-6  # metres: votes nearer to each other than this are equal
ROUNDS = 8  # of re-weighting


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
        chain = part.chain
        kept = votes.reliable[:, 0]
        centroid = vote(votes.centroid, votes.owner, kept, votes.d)
        member, valid = members(votes.owner, votes.d, self.votes)
        own_centroid, keypoints = votes.centroid[member], votes.keypoints[member]
        per_point = chain.parameters_from_keypoints(own_centroid, keypoints)
        parameters = location(per_point, valid, self.cut)[0]
        R = self._rotation(part, parameters, own_centroid, keypoints, valid)
        local = apply_inverse_pose(R[:, None], centroid[:, None], keypoints)
        folded = fold(chain, chain.keypoints_from_parameters(parameters), local)
        places, spreads = zip(*(location(v, valid, self.cut) for v in folded.unbind(2)), strict=True)
        place = torch.stack(places, 1)
        parameters = chain.parameters_from_keypoints(torch.zeros_like(centroid), place)
        own = vote_spread(votes.centroid, votes.owner, kept, centroid)
        spread = torch.stack([own, *spreads], 1)
        return InstanceVotes(centroid, apply_pose(R, centroid, place), parameters, spread)

    def _rotation(
        self, part: ParametricPart, parameters: Tensor, centroid: Tensor, keypoints: Tensor, valid: Tensor
    ) -> Tensor:
        """(d, 3, 3) part → camera, one of the equivalents, from the first points' own fits."""
        some = slice(0, self.hypotheses)
        centroid, keypoints, valid = centroid[:, some], keypoints[:, some], valid[:, some]
        parameters = parameters[:, None]
        R, t = fit_pose(part.chain, parameters, centroid, keypoints)
        misfit = _misfit(part.chain, part.chain.keypoints_from_parameters(parameters), R, t, keypoints)
        usual = _median(misfit, valid).clamp(min=FLOOR)
        weight = valid / (1 + (misfit / usual[:, None]).square())
        return mean_rotation(R, weight, part.symmetry, self.width * torch.pi / 180)


def fold(chain: KeypointChain, template: Tensor, local: Tensor) -> Tensor:
    """Carry each vote's keypoints by the symmetry element that brings them nearest to the template's.

    Args:
        chain: the part's keypoints. template: (d, m, 3) canonical keypoints, metres.
        local: (d, n, m, 3) votes carried into the part frame by the instance's pose, metres.
    Returns:
        (d, n, m, 3); free keypoints turned to the template's place on their circle.
    """
    G = chain.group.to(local)
    if len(G) > 1 and any(chain.is_finite):
        finite = torch.tensor(chain.is_finite, device=local.device)
        images = template[:, None, finite] @ G.mT  # (d, g, f, 3)
        # ‖vote − image‖² less what is the same for every element: only the products differ
        likeness = local[..., finite, :].flatten(-2) @ images.flatten(-2).mT
        chosen = G[likeness.argmax(-1)]
        local = local @ chosen
    return chain.turn_back(local)


def location(values: Tensor, valid: Tensor, cut: float) -> tuple[Tensor, Tensor]:
    """Robust mean: Tukey's biweight about the median, scaled by the median distance.

    Args:
        values: (d, n, c). valid: (d, n) bool, some True in each row. cut: see `FoldedVote`.
    Returns:
        location (d, c), and spread (d,): root mean square distance of the weighted votes.
    """
    if values.device.type == "cpu":
        from pnet.postprocess.locations import locate
    else:
        locate = _locate
    return locate(values, valid, cut, FLOOR, ROUNDS)


def _locate(values: Tensor, valid: Tensor, cut: float, floor: float, rounds: int) -> tuple[Tensor, Tensor]:
    """Plain twin of `locations.locate`."""
    centre = _median(values.transpose(1, 2), valid[:, None].expand(-1, values.shape[-1], -1))
    weight = valid.to(values)
    distance = torch.linalg.vector_norm(values - centre[:, None], dim=-1)
    for _ in range(rounds):
        scale = (cut * _median(distance, valid)).clamp(min=floor)
        weight = valid * (1 - (distance / scale[:, None]).square()).clamp(min=0).square()
        # votes so scattered that none is near: the median stands
        total = weight.sum(1, keepdim=True)
        mean = (weight[..., None] * values).sum(1) / total.clamp(min=1e-9)
        centre = torch.where(total > 1e-9, mean, centre)
        distance = torch.linalg.vector_norm(values - centre[:, None], dim=-1)
    spread = ((weight * distance.square()).sum(1) / weight.sum(1).clamp(min=1e-9)).sqrt()
    return centre, spread


def members(owner: Tensor, d: int, most: int) -> tuple[Tensor, Tensor]:
    """The first points of every cluster, as a table.

    Args:
        owner: (N,) cluster in [0, d), −1 for none; every cluster has a point. most: of a cluster.
    Returns:
        index (d, n) into the points, n at most `most`; valid (d, n) bool: False where a cluster is smaller
        (index then repeats its first point).
    """
    order = torch.argsort(owner, stable=True)[int((owner < 0).sum()) :]
    size = torch.bincount(owner[order], minlength=d)
    start = size.cumsum(0) - size
    place = torch.arange(min(most, int(size.max())), device=owner.device)
    valid = place < size[:, None]
    return order[start[:, None] + torch.where(valid, place, 0)], valid


def _median(values: Tensor, valid: Tensor) -> Tensor:
    """Lower median of the valid entries along the last dimension."""
    ordered = values.masked_fill(~valid, torch.inf).sort(-1).values
    middle = (valid.sum(-1, keepdim=True) - 1) // 2
    return ordered.gather(-1, middle).squeeze(-1)


def _misfit(chain: KeypointChain, template: Tensor, R: Tensor, t: Tensor, keypoints: Tensor) -> Tensor:
    """(...) root mean square distance of votes from the template (..., m, 3) at their own pose, metres."""
    local = apply_inverse_pose(R, t, keypoints)
    errors = [
        chain.place_like(template, local @ M.to(local)) @ M.to(local).mT - local for M in chain.chiralities
    ]
    return torch.stack([error.square().sum(-1).mean(-1) for error in errors]).amin(0).sqrt()
