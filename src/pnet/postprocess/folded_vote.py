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
from pnet.geometry.symmetry import Symmetry
from pnet.parts.base import ParametricPart
from pnet.parts.keypoints import KeypointChain
from pnet.postprocess.fit import fit_template
from pnet.postprocess.location import FLOOR, location, median
from pnet.postprocess.vote import InstanceVotes, PointVotes, vote, vote_spread

FEW = 64  # votes that tell the sizes where each might mean several exchanges


@dataclass(frozen=True)
class FoldedVote:
    """Robust voting modulo the symmetry; the radius filter serves the centroids.

    Where the network says how far off its votes are, the surer ones count more for the sizes.

    Attributes:
        hypotheses: the most points of a cluster whose poses are averaged; the first, so well spread ones.
        votes: the most points of a cluster that vote for keypoints and parameters.
        width: angle from the mean at which a hypothesis no longer counts, degrees.
        cut: distance from the location at which a vote no longer counts, in medians of that distance.
        lookalikes: whether the labels were exchanged as the part's lookalikes have it, under rule `point`.
    """

    filters_keypoints: ClassVar[bool] = False

    hypotheses: int
    votes: int
    width: float
    cut: float
    lookalikes: bool = True

    def __call__(self, part: ParametricPart, votes: PointVotes) -> InstanceVotes:
        """Fold and average; parameters are measured between the folded keypoints."""
        chain = part.chain if self.lookalikes else part.chain.without_lookalikes()
        groups, kept = votes.groups, votes.reliable[:, 0]
        centroid = vote(votes.centroid, groups, kept)
        member, valid = groups.first(self.votes)
        own_centroid, keypoints = votes.centroid[member], votes.keypoints[member]
        doubt = None if votes.doubt is None else votes.doubt[member]
        sizes = None
        if votes.parameters is not None:
            own_doubt = None if doubt is None else doubt[..., 1 + len(chain) :]
            sizes = _surest_mean(votes.parameters[member], valid, own_doubt)
        template = sizes
        if template is None:
            some = slice(0, self.votes if len(chain.lookalikes) == 1 else FEW)
            own_sizes = _own_sizes(chain, own_centroid[:, some], keypoints[:, some])
            template = location(own_sizes, valid[:, some], self.cut)[0]
        template = chain.keypoints_from_parameters(template)
        R = self._rotation(chain, part.symmetry, template, own_centroid, keypoints, valid)
        local = apply_inverse_pose(R[:, None], centroid[:, None], keypoints)
        folded, which = fold(chain, template, local)
        if doubt is not None:
            doubt = _exchanged_doubt(chain, doubt, which)
        place, spread = self._locations(folded, valid)
        place, which = likeliest(chain, place, sizes)
        spread = chain.exchanged(spread[..., None], which)[..., 0]
        expected = None
        if doubt is not None:
            each = which[:, None].expand(doubt.shape[:2])
            expected = _surest_mean(_exchanged_doubt(chain, doubt, each), valid)
        if sizes is None:
            sizes = chain.parameters_from_keypoints(torch.zeros_like(centroid), place)
        own = vote_spread(votes.centroid, groups, centroid, kept)
        spread = torch.cat([own[:, None], spread], 1)
        return InstanceVotes(centroid, apply_pose(R, centroid, place), sizes, spread, expected)

    def _rotation(
        self,
        chain: KeypointChain,
        symmetry: Symmetry,
        template: Tensor,
        centroid: Tensor,
        keypoints: Tensor,
        valid: Tensor,
    ) -> Tensor:
        """(d, 3, 3) part → camera, one of the equivalents, from the first points' own fits."""
        some = slice(0, self.hypotheses)
        centroid, keypoints, valid = centroid[:, some], keypoints[:, some], valid[:, some]
        if len(chain.lookalikes) > 1:  # each might be meant
            q = len(chain.lookalikes)
            keypoints = _all_exchanged(chain, keypoints).flatten(1, 2)
            centroid, valid = (x.repeat_interleave(q, 1) for x in (centroid, valid))
        R, t = fit_template(chain, template[:, None], centroid, keypoints)
        misfit = _misfit(chain, template[:, None], R, t, keypoints)
        usual = median(misfit, valid).clamp(min=FLOOR)
        weight = valid / (1 + (misfit / usual[:, None]).square())
        return mean_rotation(R, weight, symmetry, self.width * torch.pi / 180)

    def _locations(self, folded: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Of the keypoints (d, n, m, 3): (d, m, 3), and their spreads (d, m)."""
        d, n, m, _ = folded.shape
        values = folded.transpose(1, 2).reshape(d * m, n, 3)
        place, spread = location(values, valid[:, None].expand(d, m, n).reshape(d * m, n), self.cut)
        return place.view(d, m, 3), spread.view(d, m)


def fold(chain: KeypointChain, template: Tensor, local: Tensor) -> tuple[Tensor, Tensor]:
    """Carry each vote's keypoints by the symmetry element that brings them nearest to the template's.

    Args:
        chain: the part's keypoints. template: (d, m, 3) canonical keypoints, metres.
        local: (d, n, m, 3) votes carried into the part frame by the instance's pose, metres.
    Returns:
        (d, n, m, 3), exchanged where a lookalike was meant; free keypoints turned to the template's place on
        their circle. And which of the lookalikes (d, n) int64.
    """
    G, q = converted(chain.group, local), len(chain.lookalikes)
    which = torch.zeros(local.shape[:2], dtype=torch.int64, device=local.device)
    if (len(G) > 1 or q > 1) and any(chain.is_finite):
        images = _finite(chain, template)[:, None] @ G.mT  # (d, g, f, 3)
        # ‖vote − image‖² less what is the same for every element: only the products differ
        votes = _finite(chain, _all_exchanged(chain, local)).flatten(1, 2)  # (d, n q, f, 3)
        likeness = (votes.flatten(-2) @ images.flatten(-2).mT).unflatten(1, (-1, q)).flatten(2)
        best = likeness.argmax(-1)
        which = best // len(G)
        local = chain.exchanged(local, which) @ G[best % len(G)]
    return chain.turn_back(local), which


def likeliest(chain: KeypointChain, place: Tensor, sizes: Tensor | None) -> tuple[Tensor, Tensor]:
    """Keypoints exchanged as the template fits best.

    Args:
        place: (d, m, 3) voted keypoints, part frame, metres. sizes: (d, k) metres; None: as measured between
            the exchanged keypoints.
    Returns:
        (d, m, 3) and which of the lookalikes (d,) int64.
    """
    if len(chain.lookalikes) == 1:
        return place, torch.zeros(len(place), dtype=torch.int64, device=place.device)
    each = _all_exchanged(chain, place[:, None])[:, 0]  # (d, q, m, 3)
    centre = torch.zeros_like(each[..., 0, :])
    known = chain.parameters_from_keypoints(centre, each) if sizes is None else sizes[:, None]
    template = chain.keypoints_from_parameters(known).expand_as(each)
    which = _misfit(chain, template, *fit_template(chain, template, centre, each), each).argmin(-1)
    return chain.exchanged(place, which), which


def _own_sizes(chain: KeypointChain, centroid: Tensor, keypoints: Tensor) -> Tensor:
    """(d, n, k) sizes as every vote's own keypoints (d, n, m, 3) measure them."""
    if len(chain.lookalikes) > 1:
        away = keypoints - centroid[..., None, :]
        keypoints = likeliest(chain, away.flatten(0, 1), None)[0].view_as(away) + centroid[..., None, :]
    return chain.parameters_from_keypoints(centroid, keypoints)


def _all_exchanged(chain: KeypointChain, keypoints: Tensor) -> Tensor:
    """(d, n, m, 3) → (d, n, q, m, 3): by every one of the q lookalikes."""
    q = torch.arange(len(chain.lookalikes), device=keypoints.device)
    repeated = keypoints[:, :, None].expand(-1, -1, len(q), -1, -1)
    return chain.exchanged(repeated, q.expand(repeated.shape[:3]))


def _exchanged_doubt(chain: KeypointChain, doubt: Tensor, which: Tensor) -> Tensor:
    """(d, n, 1 + m + k) with those of the keypoints exchanged; which (d, n)."""
    m = len(chain)
    own = chain.exchanged(doubt[..., 1 : 1 + m, None], which)[..., 0]
    return torch.cat([doubt[..., :1], own, doubt[..., 1 + m :]], -1)


def _surest_mean(values: Tensor, valid: Tensor, doubt: Tensor | None = None) -> Tensor:
    """(d, q) mean of the valid (d, n) among (d, n, q); the less doubt (d, n, q) the more weight."""
    weight = valid[..., None].to(values).expand(values.shape)
    if doubt is not None:
        weight = weight / doubt.square()
    return (weight * values).sum(1) / weight.sum(1)


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
