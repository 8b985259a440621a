"""Hough voting: each cluster's reliable votes are averaged."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from pnet.parts.base import ParametricPart


@dataclass(frozen=True, eq=False)
class PointVotes:
    """What the points of one scene say of their instances.

    Attributes:
        centroid: (N, 3), keypoints: (N, m, 3) camera frame, metres.
        owner: (N,) cluster in [0, d), −1 for none. d: number of clusters.
        reliable: (N, 1 + m) bool: which votes for the centroid and each keypoint count, at least one a
            cluster; (N, 1) for a voting that weighs keypoints in its own way.
    """

    centroid: Tensor
    keypoints: Tensor
    owner: Tensor
    d: int
    reliable: Tensor


@dataclass(frozen=True, eq=False)
class InstanceVotes:
    """What the clusters agreed on.

    Attributes:
        centroid: (d, 3), keypoints: (d, m, 3) camera frame, metres. parameters: (d, k) metres.
        spread: (d, 1 + m) root mean square distance of the counted votes from it, metres.
    """

    centroid: Tensor
    keypoints: Tensor
    parameters: Tensor
    spread: Tensor


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
        voted, spread = [], []
        for values, kept in zip(targets.unbind(1), votes.reliable.unbind(1), strict=True):
            voted.append(vote(values, votes.owner, kept, votes.d))
            spread.append(vote_spread(values, votes.owner, kept, voted[-1]))
        places = torch.stack(voted, 1)
        per_point = part.chain.parameters_from_keypoints(votes.centroid, votes.keypoints)
        parameters = vote(per_point, votes.owner, votes.owner >= 0, votes.d)
        return InstanceVotes(places[:, 0], places[:, 1:], parameters, torch.stack(spread, 1))


def vote(values: Tensor, labels: Tensor, kept: Tensor, clusters: int) -> Tensor:
    """Mean of the counted votes of each cluster.

    Args:
        values: (N, ...) votes. labels: (N,) cluster, −1 for none. kept: (N,) bool, which votes count.
        clusters: d.
    Returns:
        (d, ...) means; every cluster must have a counted vote.
    """
    chosen, owner = values[kept], labels[kept]
    total = chosen.new_zeros(clusters, *values.shape[1:]).index_add_(0, owner, chosen)
    count = chosen.new_zeros(clusters).index_add_(0, owner, chosen.new_ones(len(owner)))
    mean: Tensor = total / count.view(-1, *[1] * (values.ndim - 1))
    return mean


def vote_spread(values: Tensor, labels: Tensor, kept: Tensor, means: Tensor) -> Tensor:
    """Root mean square distance of the counted votes from their mean.

    Args:
        values: (N, 3) votes, metres. labels, kept: as in `vote`. means: (d, 3) what `vote` gave, metres.
    Returns:
        (d,) metres; large where a keypoint's label is ambiguous and the votes disagree.
    """
    off = (values - means[labels.clamp(min=0)]).square().sum(-1)
    return vote(off, labels, kept, len(means)).sqrt()
