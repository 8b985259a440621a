"""Instance segmentation: mean shift on the predicted centroids (the paper's [22])."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.postprocess.mean_shift import mean_shift


@dataclass(frozen=True)
class CentroidClusters:
    """Mean shift with a flat kernel.

    Attributes:
        bandwidth: kernel radius, metres. min_seed_points: a grid cell of that size needs so many centroids
            to start a search.
        min_points: smaller clusters are left out.
    """

    bandwidth: float
    min_seed_points: int
    min_points: int

    def __call__(self, centroids: Tensor) -> Tensor:
        """Cluster the predicted centroids of one scene.

        Args:
            centroids: (N, 3) metres.
        Returns:
            (N,) int64 cluster in [0, d), −1 for points that lie in none.
        """
        if len(centroids) == 0 or not bool(torch.isfinite(centroids).all()):
            return torch.full((len(centroids),), -1)
        _, labels = mean_shift(centroids.double(), self.bandwidth, self.min_seed_points)
        return drop_small(labels, self.min_points)


def drop_small(labels: Tensor, min_points: int) -> Tensor:
    """Clusters of fewer than `min_points` become −1; the others are numbered anew without gaps."""
    if not bool((labels >= 0).any()):
        return labels
    size = torch.bincount(labels[labels >= 0])
    keep = size >= min_points
    renumbered = torch.where(keep, keep.long().cumsum(0) - 1, -1)
    return torch.where(labels >= 0, renumbered[labels.clamp(min=0)], labels)
