"""Mean shift with a flat kernel and binned seeds (Comaniciu and Meer 2002, the paper's [22]).

The same clusters as scikit-learn's `MeanShift(bin_seeding=True, cluster_all=False)`, which searches seed
by seed: here all seeds move together, by matrix products.
"""

import torch
from torch import Tensor

MAX_STEPS = 300
STOP = 1e-3  # a seed that moves by less than this share of the bandwidth has arrived


def mean_shift(points: Tensor, bandwidth: float, min_seed_points: int) -> tuple[Tensor, Tensor]:
    """Modes of a point density, and the mode of every point.

    Args:
        points: (N, 3) float64, metres. bandwidth: kernel radius, metres.
        min_seed_points: a grid cell of that size needs so many points to start a search.
    Returns:
        modes (d, 3) metres, the densest first; labels (N,) int64 of the nearest mode, −1 where that is
        farther than the bandwidth.
    """
    centres, intensity = _climb(points, _seeds(points, bandwidth, min_seed_points), bandwidth)
    modes = _distinct(centres, intensity, bandwidth)
    if not len(modes):
        return modes, torch.full((len(points),), -1, device=points.device)
    nearest = torch.cdist(points, modes).min(1)
    return modes, torch.where(nearest.values <= bandwidth, nearest.indices, -1)


def _seeds(points: Tensor, bandwidth: float, min_seed_points: int) -> Tensor:
    cells, count = torch.unique((points / bandwidth).round(), dim=0, return_counts=True)
    return cells[count >= min_seed_points] * bandwidth


def _climb(points: Tensor, seeds: Tensor, bandwidth: float) -> tuple[Tensor, Tensor]:
    """Move every seed to the mean of the points around it until it stays; its place and point count."""
    centres, intensity = seeds.clone(), torch.zeros(len(seeds), dtype=points.dtype, device=points.device)
    active = torch.arange(len(seeds), device=points.device)
    for _ in range(MAX_STEPS):
        if not len(active):
            break
        within = (torch.cdist(centres[active], points) <= bandwidth).to(points.dtype)
        count = within.sum(1)
        mean = within @ points / count.clamp(min=1)[:, None]
        mean = torch.where(count[:, None] > 0, mean, centres[active])
        moved = torch.linalg.vector_norm(mean - centres[active], dim=1)
        centres[active], intensity[active] = mean, count
        active = active[moved > STOP * bandwidth]
    return centres[intensity > 0], intensity[intensity > 0]


def _distinct(centres: Tensor, intensity: Tensor, bandwidth: float) -> Tensor:
    """Of centres within a bandwidth of each other the one with the most points, the densest first."""
    order = torch.arange(len(centres), device=centres.device)
    for key in (*centres.flip(1).unbind(1), intensity):  # ties in density go by x, then y, then z
        order = order[torch.argsort(key[order], descending=True, stable=True)]
    centres = centres[order]
    near = torch.cdist(centres, centres) <= bandwidth
    keep = torch.ones(len(centres), dtype=torch.bool)
    for i in range(len(centres)):
        if keep[i]:
            keep[i + 1 :] &= ~near[i, i + 1 :].cpu()
    return centres[keep.to(centres.device)]
