"""How sure an instance is: its visibility as its points see it, or its size."""

import torch
from torch import Tensor

from pnet.postprocess.vote import vote


def instance_score(visibility: Tensor | None, labels: Tensor, d: int) -> Tensor:
    """Score of every cluster.

    Args:
        visibility: (N,) predicted of each point, or None without M_V.
        labels: (N,) cluster in [0, d), −1 for none. d: number of clusters.
    Returns:
        (d,) float64 mean visibility of its points; without M_V the share of the scene's points in it.
    """
    if visibility is not None:
        return vote(visibility.cpu().double(), labels, labels >= 0, d)
    return torch.bincount(labels[labels >= 0], minlength=d).double() / len(labels)


def sure_enough(score: Tensor, visibility: Tensor | None, threshold: float) -> Tensor:
    """(d,) bool: whose voted visibility reaches T_v. Without M_V nothing is known of it: all stay."""
    return score >= (threshold if visibility is not None else 0.0)
