"""Layers that several backbones share; features are (..., C) rows."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn


class RowBatchNorm(nn.BatchNorm1d):
    """Batch norm over all rows of (..., C) features."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) → (..., C)."""
        normed: Tensor = super().forward(x.flatten(0, -2)).view(x.shape)
        return normed


def shared_mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Linear + batch norm + ReLU for every step of sizes (C_0, …, C_n), on (..., C_0) rows."""
    steps: list[nn.Module] = []
    for before, after in pairwise(sizes):
        steps += [nn.Linear(before, after, bias=False), RowBatchNorm(after), nn.ReLU(inplace=True)]
    return nn.Sequential(*steps)


def conv_block(before: int, after: int, stride: int = 1) -> nn.Sequential:
    """3 × 3 convolution + batch norm + ReLU on (B, C, H, W) images."""
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, 1, bias=False),
        nn.BatchNorm2d(after),
        nn.ReLU(inplace=True),
    )


def centred(points: Tensor) -> Tensor:
    """(B, N, 3) clouds moved so that each has its mean at the origin: scale without offset."""
    return points - points.mean(1, keepdim=True)


def gather_rows(rows: Tensor, index: Tensor) -> Tensor:
    """Rows of each cloud by index.

    Args:
        rows: (B, n, C). index: (B, ...) int64 into n.
    Returns:
        (B, ..., C).
    """
    flat = index.flatten(1)
    taken = torch.gather(rows, 1, flat[..., None].expand(-1, -1, rows.shape[-1]))
    return taken.view(*index.shape, rows.shape[-1])
