"""Mean shift with a flat kernel and binned seeds (Comaniciu and Meer 2002, the paper's [22]).

The same clusters as scikit-learn's `MeanShift(bin_seeding=True, cluster_all=False)`, which searches seed
by seed: here compiled, with a k-d tree; where there is no such kernel all seeds move together, by matrix
products.
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
    seeds = _seeds(points, bandwidth, min_seed_points)
    if not len(seeds):
        return seeds, torch.full((len(points),), -1, device=points.device)
    if points.device.type == "cpu":
        from pnet.postprocess.neighbourhoods import climb, nearest_mode
    else:
        climb, nearest_mode = _climb, _nearest_mode
    centres, intensity = climb(points, seeds, bandwidth, STOP * bandwidth, MAX_STEPS)
    seen = intensity > 0
    modes = _distinct(centres[seen], intensity[seen], bandwidth)
    return modes, nearest_mode(points, modes, bandwidth)


def _seeds(points: Tensor, bandwidth: float, min_seed_points: int) -> Tensor:
    """(s, 3) middles of the grid cells that hold enough points, metres, by x, then y, then z."""
    number: Tensor = torch.zeros_like(points[:, 0], dtype=torch.long)
    known = []
    for column in (points / bandwidth).round().unbind(1):  # a cell as one number: unique rows are slow
        values, place = torch.unique(column, return_inverse=True)
        number = number * len(values) + place
        known.append(values)
    cells, count = torch.unique(number, return_counts=True)
    cells, places = cells[count >= min_seed_points], []
    for values in reversed(known):
        places.append(values[cells % max(len(values), 1)])
        cells = cells // max(len(values), 1)
    return torch.stack(places[::-1], 1) * bandwidth


def _climb(points: Tensor, seeds: Tensor, bandwidth: float, stop: float, steps: int) -> tuple[Tensor, Tensor]:
    """Plain twin of `neighbourhoods.climb`: all seeds together."""
    centres, intensity = seeds.clone(), torch.zeros(len(seeds), dtype=points.dtype, device=points.device)
    active = torch.arange(len(seeds), device=points.device)
    for _ in range(steps):
        if not len(active):
            break
        within = (torch.cdist(centres[active], points) <= bandwidth).to(points.dtype)
        count = within.sum(1)
        mean = within @ points / count.clamp(min=1)[:, None]
        mean = torch.where(count[:, None] > 0, mean, centres[active])
        moved = torch.linalg.vector_norm(mean - centres[active], dim=1)
        centres[active], intensity[active] = mean, count
        active = active[moved > stop]
    return centres, intensity


def _nearest_mode(points: Tensor, modes: Tensor, bandwidth: float) -> Tensor:
    """Plain twin of `neighbourhoods.nearest_mode`."""
    if not len(modes):
        return torch.full((len(points),), -1, device=points.device)
    nearest = torch.cdist(points, modes).min(1)
    return torch.where(nearest.values <= bandwidth, nearest.indices, -1)


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
