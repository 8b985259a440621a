"""How sure an instance is: its visibility as its points see it, or its size."""

from torch import Tensor

from pnet.postprocess.grouping import Clusters
from pnet.postprocess.vote import vote


def instance_score(visibility: Tensor | None, clusters: Clusters) -> Tensor:
    """Score of every cluster.

    Args:
        visibility: (B, N) predicted of each point, or None without M_V. clusters: of the B scenes.
    Returns:
        (d,) float64 mean visibility of its points; without M_V the share of its scene's points in it.
    """
    if visibility is None:
        return clusters.groups.size.double() / clusters.owner.shape[1]
    return vote(clusters.of(visibility).double(), clusters.groups)


def sure_enough(score: Tensor, visibility: Tensor | None, threshold: float) -> Tensor:
    """(d,) bool: whose voted visibility reaches T_v. Without M_V nothing is known of it: all stay."""
    return score >= (threshold if visibility is not None else 0.0)
