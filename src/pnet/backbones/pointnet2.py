"""PointNet++ (Qi et al. 2017) with single-scale or multi-scale grouping, and with delayed aggregation."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from pnet.backbones.base import Backbone
from pnet.backbones.layers import FeaturePropagation, SetAbstraction, centred
from pnet.ops.pyramid import Ball, Pyramid, Tables


@dataclass(frozen=True)
class Level:
    """One set abstraction.

    Attributes:
        points: centres; fewer where the cloud has fewer. radius: metres, or one for each scale.
        neighbours: k of each scale. mlp: channels, the same for each scale.
        delayed: take the maximum before the last norm, so that the MLP runs per point (ASSANet, Qian et al.
            2021) and not per neighbour.
    """

    points: int
    radius: float | Sequence[float]  # as a union not for hydra.utils.instantiate; pnet's own takes it
    neighbours: int
    mlp: Sequence[int]
    delayed: bool = False


class PointNet2(Backbone):
    """Set abstraction down, feature propagation up.

    Stored points are in sampling order, so every level is a prefix of the cloud: nothing is sampled here.

    Args:
        levels: finest first. propagation: channels of the MLPs on the way up, coarsest first.
        radius_scale: multiplies every radius, for parts of another size.
    """

    def __init__(
        self,
        levels: Sequence[Level],
        propagation: Sequence[Sequence[int]],
        radius_scale: float = 1.0,
    ) -> None:
        super().__init__()
        if len(levels) != len(propagation):
            raise ValueError(
                f"backbone: {len(levels)} levels need as many propagation MLPs, got {len(propagation)}"
            )
        self.features = propagation[-1][-1]
        self.abstraction, self.propagation = nn.ModuleList(), nn.ModuleList()
        widths, balls = [0], []
        for level in levels:
            given = [level.radius] if isinstance(level.radius, float | int) else level.radius
            radii = [radius * radius_scale for radius in given]
            balls.append([Ball(radius, level.neighbours) for radius in radii])
            step = SetAbstraction(widths[-1], radii, level.mlp, level.delayed)
            self.abstraction.append(step)
            widths.append(step.features)
        width = widths.pop()
        for mlp in propagation:
            self.propagation.append(FeaturePropagation(width, widths.pop(), mlp))
            width = mlp[-1]
        self.pyramid = Pyramid([level.points for level in levels], balls, [])

    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """Down by grouping and maximum, up by interpolation and skip connections."""
        place = centred(points)
        features: list[Tensor | None] = [None]
        for i, step in enumerate(self.abstraction, 1):
            features.append(step(place, features[-1], tables, i))
            place = place[:, : tables[f"ball_{i}_0"].shape[1]]
        rising = features.pop()
        assert rising is not None
        for i, step in zip(reversed(range(1, len(self.abstraction) + 1)), self.propagation, strict=True):
            rising = step(rising, features.pop(), tables, i)
        return rising
