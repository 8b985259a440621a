"""Hough voting: each cluster's reliable votes are averaged."""

from torch import Tensor


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
