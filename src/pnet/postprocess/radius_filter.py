"""The radius filter (RF): votes that stand alone are not counted."""

from dataclasses import dataclass

from torch import Tensor

from pnet.postprocess.grouping import Groups
from pnet.postprocess.neighbour_count import near_enough


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

    def __call__(self, votes: Tensor, groups: Groups) -> Tensor:
        """Which votes count; every cluster keeps at least one, so the number of clusters stays.

        Args:
            votes: (M, q, 3) metres; each column has a verdict of its own. groups: how they stand.
        Returns:
            (M, q) bool.
        """
        return near_enough(votes.double(), groups, self.neighbours, self.enough, self._radii())

    def _radii(self) -> tuple[float, ...]:
        """All that are tried, metres."""
        radii = [self.radius]
        # a nanometre of slack: 0.01 + 5 · 0.002 is a little more than 0.02 in floating point
        while self.widen > 0 and radii[-1] + self.widen <= self.max_radius + 1e-9:
            radii.append(radii[-1] + self.widen)
        return tuple(radii)
