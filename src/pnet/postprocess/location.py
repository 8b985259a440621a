"""A robust mean: where most of the votes are, whatever the others say."""

import torch
from torch import Tensor

from pnet.postprocess.kernels import Kernels, step

FLOOR = 1e-6  # metres: votes nearer to each other than this are equal
ROUNDS = 8  # of re-weighting


def location(values: Tensor, valid: Tensor, cut: float) -> tuple[Tensor, Tensor]:
    """Tukey's biweight about the median, scaled by the median distance.

    Args:
        values: (d, n, c) float64. valid: (d, n) bool, some True in each row. cut: see `FoldedVote`.
    Returns:
        location (d, c), and spread (d,): root mean square distance of the weighted votes.
    """
    return locate(values, valid, cut, FLOOR, ROUNDS)


@step("locations", Kernels.NUMBA)
def locate(values: Tensor, valid: Tensor, cut: float, floor: float, rounds: int) -> tuple[Tensor, Tensor]:
    """`location` with the least scale, and so many rounds of re-weighting, one at least."""
    centre = median(values.transpose(1, 2), valid[:, None].expand(-1, values.shape[-1], -1))
    weight = valid.to(values)
    distance = torch.linalg.vector_norm(values - centre[:, None], dim=-1)
    for _ in range(rounds):
        scale = (cut * median(distance, valid)).clamp(min=floor)
        weight = valid * (1 - (distance / scale[:, None]).square()).clamp(min=0).square()
        # votes so scattered that none is near: the median stands
        total = weight.sum(1, keepdim=True)
        mean = (weight[..., None] * values).sum(1) / total.clamp(min=1e-9)
        centre = torch.where(total > 1e-9, mean, centre)
        distance = torch.linalg.vector_norm(values - centre[:, None], dim=-1)
    spread = ((weight * distance.square()).sum(1) / weight.sum(1).clamp(min=1e-9)).sqrt()
    return centre, spread


def median(values: Tensor, valid: Tensor) -> Tensor:
    """Lower median of the valid entries along the last dimension."""
    ordered = values.masked_fill(~valid, torch.inf).sort(-1).values
    middle = (valid.sum(-1, keepdim=True) - 1) // 2
    return ordered.gather(-1, middle).squeeze(-1)
