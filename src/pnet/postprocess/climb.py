"""Mean shift's searches: seeds climb, of modes near each other one stays, and every point goes to one."""

import torch
from torch import Tensor

from pnet.ops.operators import squared_distance
from pnet.postprocess.kernels import Kernels, step

ALL = (Kernels.NUMBA, Kernels.TRITON)


@step("climb", *ALL)
def climb(
    points: Tensor, counted: Tensor, seeds: Tensor, bandwidth: float, stop: float, steps: int
) -> tuple[Tensor, Tensor]:
    """Move every seed to the mean of the points around it until it stays.

    Args:
        points: (B, N, 3) float64, metres. counted: (B, N) bool: others are not there.
        seeds: (B, S, 3) metres, NaN behind a scene's last seed. bandwidth: radius around, metres.
        stop: a shorter step is the last one, metres. steps: at most.
    Returns:
        centres (B, S, 3) metres; intensity (B, S) how many points were around at the last step.
    """
    centres, intensity = seeds.clone(), torch.zeros_like(seeds[..., 0])
    for cloud, mask, centre, around in zip(points, counted, centres, intensity, strict=True):
        active = torch.arange(len(centre), device=points.device)
        for _ in range(steps):
            if not len(active):
                break
            old = centre[active]
            within = ((torch.cdist(old, cloud) <= bandwidth) & mask).to(points.dtype)
            count = within.sum(1)
            mean = torch.where(count[:, None] > 0, within @ cloud / count.clamp(min=1)[:, None], old)
            centre[active], around[active] = mean, count
            active = active[torch.linalg.vector_norm(mean - old, dim=1) > stop]
    return centres, intensity


@step("climb", *ALL)
def distinct(centres: Tensor, seen: Tensor, bandwidth: float) -> Tensor:
    """Which centres stay: those seen that are not within a bandwidth of an earlier one that stays.

    Args:
        centres: (B, S, 3) float64, metres. seen: (B, S) bool.
    Returns:
        (B, S) bool.
    """
    near = squared_distance(centres[:, :, None], centres[:, None]) <= bandwidth * bandwidth
    earlier, stays, undecided = near.tril(-1), torch.zeros_like(seen), seen
    while bool(undecided.any()):
        new = undecided & ~(earlier & undecided[:, None]).any(2)
        stays = stays | new
        undecided = undecided & ~new & ~(earlier & new[:, None]).any(2)
    return stays


@step("climb", *ALL)
def nearest_mode(points: Tensor, modes: Tensor, number: Tensor, bandwidth: float) -> Tensor:
    """The first of the nearest modes of each point in its own scene.

    Args:
        points: (B, N, 3), modes: (B, S, 3) float64, metres. number: (B,) int64 of each scene's modes.
    Returns:
        (B, N) int64; −1 where the mode is farther than the bandwidth, or there is none.
    """
    labels = torch.full(points.shape[:2], -1, device=points.device)
    widest = int(number.max()) if modes.numel() else 0
    if not widest:
        return labels
    there = torch.arange(widest, device=points.device) < number[:, None]
    for cloud, mode, own, label in zip(points, modes[:, :widest], there, labels, strict=True):
        square = squared_distance(cloud[:, None], mode).masked_fill(~own, torch.inf)
        least = square.amin(1, keepdim=True)
        first = torch.where(square == least, torch.arange(widest, device=points.device), widest).amin(1)
        label.copy_(torch.where(least[:, 0] <= bandwidth * bandwidth, first, -1))
    return labels
