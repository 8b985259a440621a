"""Hough voting: each cluster's reliable votes are averaged."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from pnet.ops.gathering import scatter_sum
from pnet.parts.base import ParametricPart
from pnet.postprocess.grouping import Groups


@dataclass(frozen=True, eq=False)
class PointVotes:
    """What the clustered points say of their instances.

    Attributes:
        centroid: (M, 3), keypoints: (M, m, 3) camera frame, metres. groups: how they stand.
        reliable: (M, 1 + m) bool: which votes for the centroid and each keypoint count, at least one a
            cluster; (M, 1) for a voting that weighs keypoints in its own way.
        doubt: (M, 1 + m + k), parameters: (M, k) metres, see `PointPrediction`; None where the network has no
            such head.
    """

    centroid: Tensor
    keypoints: Tensor
    groups: Groups
    reliable: Tensor
    doubt: Tensor | None = None
    parameters: Tensor | None = None


@dataclass(frozen=True, eq=False)
class InstanceVotes:
    """What the clusters agreed on.

    Attributes:
        centroid: (d, 3), keypoints: (d, m, 3) camera frame, metres. parameters: (d, k) metres.
        spread: (d, 1 + m) root mean square distance of the counted votes from it, metres.
        doubt: (d, 1 + m + k) how far off centroid, keypoints and parameters are expected to be, metres, or
            None where the network does not say.
    """

    centroid: Tensor
    keypoints: Tensor
    parameters: Tensor
    spread: Tensor
    doubt: Tensor | None = None


class Voting(Protocol):
    """Brings the votes of every cluster together.

    Attributes:
        filters_keypoints: whether the radius filter's verdict on keypoint votes is used.
    """

    filters_keypoints: ClassVar[bool]

    def __call__(self, part: ParametricPart, votes: PointVotes) -> InstanceVotes:
        """One set of keypoints and parameters for every cluster."""
        ...


@dataclass(frozen=True)
class MeanVote:
    """The paper's: plain means; the votes of an instance must mean the same one of the equivalent
    keypoints."""

    filters_keypoints: ClassVar[bool] = True

    def __call__(self, part: ParametricPart, votes: PointVotes) -> InstanceVotes:
        """Means of centroids, keypoints and, point by point (module M_P), parameters."""
        targets = torch.cat([votes.centroid[:, None], votes.keypoints], 1)
        places = vote(targets, votes.groups, votes.reliable)
        spread = vote_spread(targets, votes.groups, places, votes.reliable)
        per_point = votes.parameters
        if per_point is None:
            per_point = part.chain.parameters_from_keypoints(votes.centroid, votes.keypoints)
        doubt = None if votes.doubt is None else vote(votes.doubt, votes.groups)
        return InstanceVotes(places[:, 0], places[:, 1:], vote(per_point, votes.groups), spread, doubt)


def vote(values: Tensor, groups: Groups, kept: Tensor | None = None) -> Tensor:
    """Mean of the counted votes of each cluster.

    Args:
        values: (M, ...) votes. groups: how they stand.
        kept: (M,) bool, which votes count, at least one a cluster, or (M, q) for votes (M, q, ...) of which
            each column has its own; None: all count.
    Returns:
        (d, ...) means.
    """
    if kept is None:
        kept = torch.ones(len(values), dtype=torch.bool, device=values.device)
    over = kept.view(*kept.shape, *[1] * (values.ndim - kept.ndim))
    total = _sums(values.masked_fill(~over, 0), groups)
    return total / _sums(over.to(values), groups)


def vote_spread(values: Tensor, groups: Groups, means: Tensor, kept: Tensor) -> Tensor:
    """Root mean square distance of the counted votes from their mean.

    Args:
        values: (M, ..., 3) votes, metres. groups, kept: as in `vote`. means: (d, ..., 3) what `vote` gave.
    Returns:
        (d, ...) metres; large where a keypoint's label is ambiguous and the votes disagree.
    """
    off = (values - means[groups.owner]).square().sum(-1)
    return vote(off, groups, kept).sqrt()


def _sums(rows: Tensor, groups: Groups) -> Tensor:
    """(d, ...) sums of the rows (M, ...) of each cluster, in their order."""
    flat = rows.reshape(1, len(rows), rows.shape[1:].numel())
    return scatter_sum(flat, groups.owner.view(1, -1, 1), len(groups)).view(len(groups), *rows.shape[1:])
