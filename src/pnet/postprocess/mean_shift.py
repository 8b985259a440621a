"""Mean shift with a flat kernel and binned seeds (Comaniciu and Meer 2002, the paper's [22]).

The same clusters as scikit-learn's `MeanShift(bin_seeding=True, cluster_all=False)`, which searches seed
by seed. Tables over the seeds of B scenes have S columns, as many as the scene with the most has seeds.
"""

import torch
from torch import Tensor

from pnet.postprocess.climb import climb, distinct, nearest_mode

MAX_STEPS = 300
STOP = 1e-3  # a seed that moves by less than this share of the bandwidth has arrived


def mean_shift(
    points: Tensor, counted: Tensor, bandwidth: float, min_seed_points: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Modes of the point density of every scene, and the mode of every point.

    Args:
        points: (B, N, 3) float64, metres, finite where counted. counted: (B, N) bool; others are not there.
        bandwidth: kernel radius, metres.
        min_seed_points: a grid cell of that size needs so many points to start a search.
    Returns:
        modes (B, S, 3) metres, a scene's densest first; number (B,) int64 of each scene's modes, what stands
        behind them means nothing; labels (B, N) int64 of the nearest mode, −1 where that is farther than the
        bandwidth.
    """
    points = points.masked_fill(~counted[..., None], 0.0).contiguous()
    seeds = find_seeds(points, counted, bandwidth, min_seed_points)
    centres, intensity = climb(points, counted, seeds, bandwidth, STOP * bandwidth, MAX_STEPS)
    modes, number = _modes(centres, intensity, bandwidth)
    labels = nearest_mode(points, modes, number, bandwidth)
    return modes, number, torch.where(counted, labels, -1)


def find_seeds(points: Tensor, counted: Tensor, bandwidth: float, min_seed_points: int) -> Tensor:
    """Middles of the grid cells that hold enough points; arguments as in `mean_shift`.

    Returns:
        (B, S, 3) metres, by x, then y, then z; NaN behind a scene's last seed.
    """
    B, n, _ = points.shape
    width = points.new_full((), bandwidth)  # a GPU divides by a plain number less exactly
    cell = ((points / width).round() + 0.0).reshape(-1, 3)  # no negative zeros
    scene = torch.arange(B, device=points.device)[:, None].expand(B, n).masked_fill(~counted, B).reshape(-1)
    order = _sorted_by(scene, *cell.unbind(1))
    cell, scene = cell[order], scene[order]
    change = (cell[1:] != cell[:-1]).any(1) | (scene[1:] != scene[:-1])
    first = torch.cat([change.new_ones(min(len(cell), 1)), change])
    run = first.long().cumsum(0) - 1
    size = torch.zeros_like(run).scatter_add_(0, run, torch.ones_like(run))
    return _table(cell * width, scene, first & (size[run] >= min_seed_points) & (scene < B), B)


def _table(rows: Tensor, scene: Tensor, chosen: Tensor, B: int) -> Tensor:
    """The chosen rows (M, 3), scene after scene, as (B, S, 3) with NaN behind the last of each scene."""
    number = torch.zeros(B + 1, dtype=torch.int64, device=rows.device).scatter_add_(0, scene, chosen.long())
    before = number.cumsum(0) - number
    widest = int(number.max())
    place = scene * widest + chosen.long().cumsum(0) - 1 - before[scene]
    table = rows.new_full((B * widest + 1, 3), torch.nan)  # the last row takes what is not chosen
    table.index_copy_(0, torch.where(chosen, place, B * widest), rows)
    return table[:-1].view(B, widest, 3)


def _modes(centres: Tensor, intensity: Tensor, bandwidth: float) -> tuple[Tensor, Tensor]:
    """Of centres within a bandwidth of each other the one with the most points, the densest first.

    Args:
        centres: (B, S, 3) metres. intensity: (B, S) points around each; where there are none it is no mode.
    Returns:
        modes (B, S, 3) metres, number (B,) int64.
    """
    # ties in density go by x, then y, then z
    order = _sorted_by(intensity, *centres.unbind(-1), descending=True)
    centres, seen = _rows(centres, order), intensity.gather(1, order) > 0
    kept = distinct(centres, seen, bandwidth)
    return _rows(centres, torch.argsort((~kept).byte(), dim=1, stable=True)), kept.sum(1)


def _sorted_by(*keys: Tensor, descending: bool = False) -> Tensor:
    """Places along the last dimension, by the first key, ties by the second, …"""
    order = torch.argsort(keys[-1], dim=-1, descending=descending, stable=True)
    for key in reversed(keys[:-1]):
        next_order = torch.argsort(key.gather(-1, order), dim=-1, descending=descending, stable=True)
        order = order.gather(-1, next_order)
    return order


def _rows(table: Tensor, order: Tensor) -> Tensor:
    return table.gather(1, order[..., None].expand(*order.shape, 3))
