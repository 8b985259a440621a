"""Points learn from the others of their instance: features are pooled where centroid votes meet.

A point sees as far as its backbone's neighbourhoods reach; which end of a long part it lies on is decided
farther away. Points of one instance vote for one centroid (M_C), so that in the space of these votes an
instance is a small heap, whatever its size (VoteNet: Qi et al., ICCV 2019).
"""

from math import prod

import torch
from torch import Tensor, nn

from pnet.backbones.layers import shared_mlp
from pnet.ops.gathering import gather_rows, scatter_sum

SIDES = (32, 32, 8)  # cells of the table across, down and in depth; votes so many cells apart share one


class InstancePooling(nn.Module):
    """Means of features over cells of the votes, in two grids that are half a cell apart.

    Args:
        features: F. hidden: channels that are pooled.
        cell: width of a cell, metres: larger than the votes of an instance scatter, smaller than the distance
            of two centroids.
        scale: metres per unit of the votes' offsets.
    """

    def __init__(self, features: int, hidden: int, cell: float, scale: float) -> None:
        super().__init__()
        if cell <= 0:
            raise ValueError(f"model.pooling is {cell}, expected a positive width in metres, or null")
        self._cell, self._scale = cell, scale
        self.before = shared_mlp([features + 3, hidden])
        self.after = shared_mlp([features + 3 + 2 * hidden, hidden, features])

    def forward(self, features: Tensor, points: Tensor, votes: Tensor) -> Tensor:
        """Features that know of their instance.

        Args:
            features: (B, N, F). points: (B, N, 3), votes: (B, N, 3) for the centroids, metres; the votes get
                no gradient from here.
        Returns:
            (B, N, F).
        """
        votes = votes.detach().float()
        offset = ((votes - points) / self._scale).to(features)
        own = self.before(torch.cat([features, offset], -1))
        shared = [self._pooled(own, votes / self._cell + shift) for shift in (0.0, 0.5)]
        after: Tensor = self.after(torch.cat([features, offset, *shared], -1))
        return after

    def _pooled(self, own: Tensor, place: Tensor) -> Tensor:
        """(B, N, hidden) means over the cells of `place` (B, N, 3), in cells."""
        # a far-off vote of an untrained network is no number of a cell
        x, y, z = place.floor().clamp(-1e6, 1e6).long().unbind(-1)
        cell = (x % SIDES[0] * SIDES[1] + y % SIDES[1]) * SIDES[2] + z % SIDES[2]
        rows = torch.cat([own.float(), torch.ones_like(own[..., :1], dtype=torch.float32)], -1)
        total = scatter_sum(rows, cell[..., None], prod(SIDES))
        summed = gather_rows(total, cell)
        return (summed[..., :-1] / summed[..., -1:]).to(own)


def pooling_of(features: int, cell: float | None, scale: float) -> InstancePooling | None:
    """A network's pooling as wide as its features F; None where the setting `cell` is."""
    return None if cell is None else InstancePooling(features, features, cell, scale)
