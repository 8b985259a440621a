"""Points by their cluster, the clusters of all scenes numbered through."""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Groups:
    """How rows stand cluster after cluster.

    Attributes:
        owner: (M,) int64 the cluster of each row in [0, d), ascending.
        size: (d,) int64 rows of each cluster, one at least. largest: of the sizes.
    """

    owner: Tensor
    size: Tensor
    largest: int

    def __len__(self) -> int:
        """d, the number of clusters."""
        return len(self.size)

    def first(self, most: int) -> tuple[Tensor, Tensor]:
        """The first rows of every cluster, as a table.

        Args:
            most: rows of a cluster.
        Returns:
            index (d, n) into the rows, n at most `most`; valid (d, n) bool: False where a cluster is smaller
            (index then repeats its first row).
        """
        place = torch.arange(min(most, self.largest), device=self.size.device)
        valid = place < self.size[:, None]
        start = self.size.cumsum(0) - self.size
        return start[:, None] + torch.where(valid, place, 0), valid


@dataclass(frozen=True, eq=False)
class Clusters:
    """The clusters of B scenes, numbered through: the first scene's, then the second's, …

    Attributes:
        owner: (B, N) int64 cluster of each point in [0, d), −1 for none.
        member: (M,) int64 the clustered points among all B · N: cluster after cluster, in each by number.
        groups: how these stand. scenes: the number of each scene's clusters.
    """

    owner: Tensor
    member: Tensor
    groups: Groups
    scenes: list[int]

    def of(self, values: Tensor) -> Tensor:
        """(M, ...) what the members say, of what all points say (B, N, ...)."""
        return values.flatten(0, 1)[self.member]


def clusters_of(owner: Tensor) -> Clusters:
    """Sort points by their cluster.

    Args:
        owner: (B, N) int64 as `Clusters` has it; every number up to the largest has a point.
    """
    scenes, points = owner.shape
    size = cluster_sizes(owner, scenes * points)
    nothing = owner.new_full((scenes, 1), -1)
    end = torch.cat([nothing, owner], 1).amax(1).cummax(0).values + 1  # of each scene's numbers
    largest = torch.cat([size.new_zeros(1), size]).max()
    # the one wait for the device: how many there are
    *ends, clustered, most = torch.cat([end, torch.stack([size.sum(), largest])]).tolist()
    order = torch.argsort(owner.flatten(), stable=True)
    member, size = order[len(order) - clustered :], size[: ends[-1] if ends else 0]
    groups = Groups(torch.repeat_interleave(size, output_size=clustered), size, most)
    return Clusters(owner, member, groups, [after - before for before, after in pairwise([0, *ends])])


def cluster_sizes(owner: Tensor, d: int) -> Tensor:
    """(d,) int64 points of each cluster. owner: (...) cluster in [0, d), −1 for none."""
    place = owner.flatten() + 1
    counted = torch.zeros(d + 1, dtype=torch.int64, device=owner.device)
    return counted.scatter_add_(0, place, torch.ones_like(place))[1:]
