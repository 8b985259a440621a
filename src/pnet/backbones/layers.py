"""Layers that several backbones share; features are (..., C) rows."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pnet.ops.gathering import gather_max, gather_rows, gather_sum
from pnet.ops.grouping import group_max
from pnet.ops.pyramid import Tables


class RowBatchNorm(nn.BatchNorm1d):
    """Batch norm over all rows of (..., C) features."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) → (..., C)."""
        normed: Tensor = super().forward(x.flatten(0, -2)).view(x.shape)
        return normed

    def folded(self) -> tuple[Tensor, Tensor]:
        """Scale (C,) and shift (C,) that do the same in evaluation."""
        assert self.running_var is not None and self.running_mean is not None
        scale = self.weight / (self.running_var + self.eps).sqrt()
        return scale, self.bias - self.running_mean * scale


class Dense(nn.Module):
    """Linear + batch norm + ReLU on (..., before) rows; in evaluation one product.

    Args:
        before, after: channels. activate: False leaves the ReLU out.
    """

    def __init__(self, before: int, after: int, activate: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(before, after, bias=False)
        self.norm = RowBatchNorm(after)
        self._activate = activate

    def forward(self, x: Tensor) -> Tensor:
        """(..., before) → (..., after)."""
        if self.training:
            x = self.norm(self.linear(x))
            return F.relu(x) if self._activate else x
        scale, shift = self.norm.folded()
        x = F.linear(x, self.linear.weight * scale[:, None], shift)
        return F.relu(x, inplace=True) if self._activate else x


def shared_mlp(sizes: Sequence[int]) -> nn.Sequential:
    """A `Dense` layer for every step of sizes (C_0, …, C_n), on (..., C_0) rows."""
    return nn.Sequential(*(Dense(before, after) for before, after in pairwise(sizes)))


class RelativeDense(nn.Module):
    """Linear + batch norm + ReLU of neighbours' features and places relative to a centre.

    W [x_j − x_i; f_j] = (W_x x_j + W_f f_j) − W_x x_i: the product is taken per point, not per pair.

    Args:
        features: C, 0 for places alone. after: channels. radius: unit of the places, metres.
        side: neighbours that are concatenated before the product: PointSIFT's 1 × 2 convolution has 2.
    """

    def __init__(self, features: int, after: int, radius: float, side: int = 1) -> None:
        super().__init__()
        self.linear = nn.Linear(side * (3 + features), after, bias=False)
        self.norm = RowBatchNorm(after)
        self._radius, self._side, self._after = radius, side, after

    def forward(self, points: Tensor, features: Tensor | None, index: Tensor) -> Tensor:
        """Of every centre and neighbour.

        Args:
            points: (B, n, 3) metres, centred; the first M are the centres. features: (B, n, C) or None.
            index: (B, M, k) int64 into n, k a multiple of `side`.
        Returns:
            (B, M, k / side, after).
        """
        scale, shift = (None, None) if self.training else self.norm.folded()
        rows, own = self._rows(points, features, scale)
        centres = own[:, : index.shape[1]]
        if self._side == 1:
            gathered = gather_rows(rows, index)
        else:  # rows of one point stand side by side, one for each place in the group
            place = torch.arange(index.shape[2], device=index.device) % self._side
            groups = (self._side * index + place).unflatten(2, (-1, self._side))
            gathered = gather_sum(rows, groups.flatten(1, 2)).unflatten(1, groups.shape[1:3])
        if shift is None:
            return F.relu(self.norm(gathered - centres[:, :, None]))
        return F.relu(gathered.add_((shift - centres)[:, :, None]), inplace=True)

    def largest(self, points: Tensor, features: Tensor | None, index: Tensor) -> Tensor:
        """The maximum over neighbours, before norm and ReLU (delayed aggregation): (B, M, after)."""
        rows, own = self._rows(points, features, None)
        return F.relu(self.norm(gather_max(rows, index) - own[:, : index.shape[1]]))

    def _rows(self, points: Tensor, features: Tensor | None, scale: Tensor | None) -> tuple[Tensor, Tensor]:
        """Products of every point (B, side · n, after), and what its own place adds as a centre."""
        weight = self.linear.weight if scale is None else self.linear.weight * scale[:, None]
        sides = weight.unflatten(1, (self._side, -1))  # (after, side, 3 + C)
        # differences of places far from the origin: not in bfloat16
        with torch.autocast(points.device.type, enabled=False):
            places = F.linear(points / self._radius, sides[..., :3].transpose(0, 1).flatten(0, 1))
        own = places.unflatten(2, (self._side, -1)).sum(2)
        rows = places
        if features is not None:
            rows = F.linear(features, sides[..., 3:].transpose(0, 1).flatten(0, 1)) + places
        return rows.reshape(len(points), -1, self._after), own


class SetAbstraction(nn.Module):
    """Features of centres from the points around them (PointNet++), at one or several scales.

    Args:
        features: C of the level below. radii: of the scales, metres. mlp: channels, the same for each scale.
        delayed: the MLP runs per point and the maximum is taken before its last norm and ReLU (ASSANet's
            order): n rows instead of M k for M centres with k neighbours.
    """

    def __init__(self, features: int, radii: Sequence[float], mlp: Sequence[int], delayed: bool) -> None:
        super().__init__()
        if delayed and features == 0 and len(mlp) > 1:
            raise ValueError(
                f"backbone: a delayed level needs features below it for its MLP {list(mlp)}; "
                "set delayed: false, or give it one layer"
            )
        self._delayed = delayed
        self.features = len(radii) * mlp[-1]
        if delayed:
            self.before = nn.ModuleList(shared_mlp([features, *mlp[:-1]]) for _ in radii)
            width = mlp[-2] if len(mlp) > 1 else features
            self.relative = nn.ModuleList(RelativeDense(width, mlp[-1], radius) for radius in radii)
        else:
            self.relative = nn.ModuleList(RelativeDense(features, mlp[0], radius) for radius in radii)
            self.after = nn.ModuleList(shared_mlp(mlp) for _ in radii)

    def forward(self, points: Tensor, features: Tensor | None, tables: Tables, level: int) -> Tensor:
        """(B, n, 3) centred metres, (B, n, C) or None → (B, M, features); tables of a `Pyramid`."""
        scales = []
        for s, relative in enumerate(self.relative):
            assert isinstance(relative, RelativeDense)
            index = tables[f"ball_{level}_{s}"]
            if self._delayed:
                own = features if features is None else self.before[s](features)
                scales.append(relative.largest(points, own, index))
            else:
                scales.append(group_max(self.after[s](relative(points, features, index))))
        return torch.cat(scales, -1)


class FeaturePropagation(nn.Module):
    """Features of a finer level by interpolation, beside its own (PointNet++).

    Args:
        features: of the coarser level. skip: of the finer level, 0 for none. mlp: channels.
    """

    def __init__(self, features: int, skip: int, mlp: Sequence[int]) -> None:
        super().__init__()
        self.mlp = shared_mlp([features + skip, *mlp])

    def forward(self, coarse: Tensor, skip: Tensor | None, tables: Tables, level: int) -> Tensor:
        """(B, M, features) of `level`, (B, n, skip) or None of the level below → (B, n, mlp[-1])."""
        spread = gather_sum(coarse, tables[f"near_{level}"], tables[f"weight_{level}"])
        merged: Tensor = self.mlp(spread if skip is None else torch.cat([spread, skip.to(spread)], -1))
        return merged


def conv_block(before: int, after: int, stride: int = 1) -> nn.Sequential:
    """3 × 3 convolution + batch norm + ReLU on (B, C, H, W) images."""
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, 1, bias=False),
        nn.BatchNorm2d(after),
        nn.ReLU(inplace=True),
    )


def centred(points: Tensor) -> Tensor:
    """(B, N, 3) clouds moved so that each has its mean at the origin: differences lose no digits."""
    return points - points.mean(1, keepdim=True)
