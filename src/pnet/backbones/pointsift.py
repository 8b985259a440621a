"""PointSIFT (Jiang et al. 2018) as the released ParametricNet configures it: the paper's backbone."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pnet.backbones.base import Backbone
from pnet.backbones.layers import Dense, FeaturePropagation, RelativeDense, SetAbstraction, centred
from pnet.ops.pyramid import Ball, Pyramid, Tables


class OrientationEncoding(nn.Module):
    """The nearest neighbour of each octant, merged along z, then y, then x by 1 × 2 convolutions.

    Args:
        features: C. after: channels. radius: unit of relative places, metres. activate: the last ReLU.
    """

    def __init__(self, features: int, after: int, radius: float, activate: bool = True) -> None:
        super().__init__()
        self.along_z = RelativeDense(features, after, radius, side=2)
        self.along_y = Dense(2 * after, after)
        self.along_x = Dense(2 * after, after, activate)

    def forward(self, points: Tensor, features: Tensor | None, octants: Tensor) -> Tensor:
        """(B, n, 3) centred metres, (B, n, C) or None, (B, n, 8) → (B, n, after)."""
        pairs = self.along_z(points, features, octants)
        merged: Tensor = self.along_x(self.along_y(pairs.unflatten(2, (2, 2)).flatten(3)).flatten(2))
        return merged


class ResidualEncoding(nn.Module):
    """Two orientation encodings, and the input added to the second (brought to its width where it differs).

    Args:
        features, after, radius: as in `OrientationEncoding`; without features nothing is added.
    """

    def __init__(self, features: int, after: int, radius: float) -> None:
        super().__init__()
        self.first = OrientationEncoding(features, after, radius)
        self.second = OrientationEncoding(after, after, radius, activate=False)
        self.match = Dense(features, after) if features not in (0, after) else None

    def forward(self, points: Tensor, features: Tensor | None, octants: Tensor) -> Tensor:
        """Shapes as in `OrientationEncoding`."""
        encoded: Tensor = self.second(points, self.first(points, features, octants), octants)
        if features is not None:
            encoded = encoded + (features if self.match is None else self.match(features))
        return F.relu(encoded)


@dataclass(frozen=True)
class SiftLevel:
    """One level on the way down and its counterpart on the way up.

    Attributes:
        octants: radius of the octant search, metres. residual: channels of the residual encodings, one
            after another; the outputs of several are concatenated and merged to the last's channels.
        points: centres of the set abstraction. radius, neighbours, mlp: of it, metres.
        propagation: channels of the MLP that comes back to this level.
        encodings: of the modules after it. in_sequence: whether each takes the one before it or all take the
            same features; the outputs of several are concatenated and merged to `propagation[-1]`.
    """

    octants: float
    residual: Sequence[int]
    points: int
    radius: float
    neighbours: int
    mlp: Sequence[int]
    propagation: Sequence[int]
    encodings: Sequence[int]
    in_sequence: bool = True


class PointSIFT(Backbone):
    """Orientation encoding between the levels of a PointNet++.

    Args:
        levels: finest first. radius_scale: multiplies every radius, for parts of another size.
    """

    def __init__(self, levels: Sequence[SiftLevel], radius_scale: float = 1.0) -> None:
        super().__init__()
        self.down, self.abstraction = nn.ModuleList(), nn.ModuleList()
        self.up, self.propagation = nn.ModuleList(), nn.ModuleList()
        width = 0
        skips: list[int] = []
        for level in levels:
            skips.append(width)
            reach, widths = level.octants * radius_scale, [width, *level.residual]
            encoders = [ResidualEncoding(a, b, reach) for a, b in pairwise(widths)]
            self.down.append(Merge(encoders, level.residual))
            step = SetAbstraction(widths[-1], [level.radius * radius_scale], level.mlp, delayed=False)
            self.abstraction.append(step)
            width = step.features
        for level, skip in zip(reversed(levels), reversed(skips), strict=True):
            self.propagation.append(FeaturePropagation(width, skip, level.propagation))
            first = level.propagation[-1]
            widths = [first, *(level.encodings if level.in_sequence else [first] * len(level.encodings))]
            reach = level.octants * radius_scale
            steps = zip(widths, level.encodings, strict=False)
            encodings = [OrientationEncoding(a, b, reach) for a, b in steps]
            self.up.append(Merge(encodings, level.encodings, level.in_sequence))
            width = level.encodings[-1]
        self.features = width
        self.pyramid = Pyramid(
            [level.points for level in levels],
            [[Ball(level.radius * radius_scale, level.neighbours)] for level in levels],
            [level.octants * radius_scale for level in levels],
        )

    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """Down and up; skip connections carry the features from before a level's encodings."""
        places, features = [centred(points)], None
        skips: list[Tensor | None] = []
        for i, (encode, abstract) in enumerate(zip(self.down, self.abstraction, strict=True)):
            skips.append(features)
            encoded = encode(places[-1], features, tables[f"octants_{i}"])
            features = abstract(places[-1], encoded, tables, i + 1)
            places.append(places[-1][:, : features.shape[1]])
        for propagate, encode in zip(self.propagation, self.up, strict=True):
            i = len(places) - 2
            features = propagate(features, skips[i], tables, i + 1)
            features = encode(places[i], features, tables[f"octants_{i}"])
            places.pop()
        assert features is not None
        return features


class Merge(nn.Module):
    """Modules whose outputs are concatenated and merged; a single one stands alone.

    Args:
        modules: (points, features, octants) → features. widths: of their outputs; the last is the merged one.
        in_sequence: each module takes the features of the one before it.
    """

    def __init__(self, modules: Sequence[nn.Module], widths: Sequence[int], in_sequence: bool = True) -> None:
        super().__init__()
        self.encodings = nn.ModuleList(modules)
        self.merge = Dense(sum(widths), widths[-1]) if len(modules) > 1 else None
        self._in_sequence = in_sequence

    def forward(self, points: Tensor, features: Tensor | None, octants: Tensor) -> Tensor:
        """(B, n, 3), (B, n, C) or None, (B, n, 8) → (B, n, widths[-1])."""
        outputs, given = [], features
        for encode in self.encodings:
            outputs.append(encode(points, given, octants))
            given = outputs[-1] if self._in_sequence else features
        if self.merge is None:
            return outputs[0]
        merged: Tensor = self.merge(torch.cat(outputs, -1))
        return merged
