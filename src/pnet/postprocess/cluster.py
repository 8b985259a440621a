"""Instance segmentation: mean shift on the predicted centroids (the paper's [22])."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.postprocess.grouping import cluster_sizes
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

    def __call__(self, centroids: Tensor, counted: Tensor | None = None) -> Tensor:
        """Cluster the predicted centroids of every scene.

        Args:
            centroids: (B, N, 3) metres; a scene that counts one which is no number has no cluster.
            counted: (B, N) bool, which points are there; None: all.
        Returns:
            (B, N) int64 cluster, numbered through from scene to scene, −1 for points that lie in none.
        """
        if counted is None:
            counted = torch.ones_like(centroids[..., 0], dtype=torch.bool)
        sound = (torch.isfinite(centroids).all(-1) | ~counted).all(1, keepdim=True)
        points = centroids.double()
        modes, _, labels = mean_shift(points, counted & sound, self.bandwidth, self.min_seed_points)
        scenes, most, _ = modes.shape
        first = most * torch.arange(scenes, device=labels.device)[:, None]
        return drop_small(torch.where(labels >= 0, first + labels, -1), scenes * most, self.min_points)


def drop_small(labels: Tensor, d: int, min_points: int) -> Tensor:
    """Clusters of fewer than `min_points`, or none, become −1; the others are numbered anew without gaps.

    Args:
        labels: (...) int64 cluster in [0, d), −1 for none; some may have no point.
    """
    keep = cluster_sizes(labels, d) >= max(min_points, 1)
    renumbered = torch.where(keep, keep.long().cumsum(0) - 1, -1)
    # the last entry serves label −1
    return torch.cat([renumbered, renumbered.new_full((1,), -1)])[labels]
