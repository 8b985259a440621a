"""The radius filter (RF): votes that stand alone are not counted."""

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor


@dataclass(frozen=True)
class RadiusFilter:
    """Keep a vote that has enough other votes of its cluster near it.

    Attributes:
        radius: metres. neighbours: how many other votes must lie within it.
        widen, max_radius: where fewer than `enough` of a cluster's votes are kept, the radius grows by
            `widen` up to `max_radius`, metres. enough: a share of the cluster.
    """

    radius: float
    neighbours: int
    widen: float
    max_radius: float
    enough: float

    def __call__(self, votes: Tensor, labels: Tensor) -> Tensor:
        """Which votes count; every cluster keeps at least one, so the number of clusters stays.

        Args:
            votes: (N, 3) metres. labels: (N,) cluster, −1 for none.
        Returns:
            (N,) bool; False where the label is −1.
        """
        kept = labels >= 0
        for cluster in range(int(labels.max()) + 1 if len(labels) else 0):
            members = torch.nonzero(labels == cluster).squeeze(1)
            kept[members] = self._kept(votes[members])
        return kept

    def _kept(self, votes: Tensor) -> Tensor:
        places = votes.double().cpu().numpy()
        tree, radius = cKDTree(places), self.radius
        while True:
            near = tree.query_ball_point(places, radius, return_length=True)
            kept = torch.from_numpy(near - 1 >= self.neighbours).to(votes.device)
            if float(kept.double().mean()) >= self.enough:
                return kept
            radius += self.widen
            # a nanometre of slack: 0.01 + 5 · 0.002 is a little more than 0.02 in floating point
            if radius > self.max_radius + 1e-9 or self.widen <= 0:
                # nothing is dense enough: better all votes than an instance without any
                return kept if bool(kept.any()) else torch.ones_like(kept)
