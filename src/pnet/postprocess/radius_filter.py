"""The radius filter (RF): votes that stand alone are not counted."""

from dataclasses import dataclass

import torch
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
        from pnet.postprocess.neighbourhoods import near_enough

        order = torch.argsort(labels, stable=True)[int((labels < 0).sum()) :]
        end = torch.bincount(labels[order]).cumsum(0).cpu()
        widening = (self.radius, self.widen, self.max_radius)
        near = near_enough(votes[order].double().cpu(), end, self.neighbours, self.enough, widening)
        kept = torch.zeros_like(labels, dtype=torch.bool)
        kept[order] = near.to(kept.device)
        return kept
