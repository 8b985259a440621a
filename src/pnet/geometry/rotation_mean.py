"""Mean rotation modulo a symmetry group, robust against outliers."""

import math

import roma
import torch
from torch import Tensor

from pnet.geometry.symmetry import Symmetry, nearest_equivalent

STARTS = 12  # hypotheses from which the climb to a mode starts
SUPPORTERS = 64  # the first hypotheses, by which starts are compared
ROUNDS = 10  # of re-weighting


def mean_rotation(R: Tensor, weight: Tensor, symmetry: Symmetry, width: float) -> Tensor:
    """The rotation on which most hypotheses agree, up to the symmetry.

    Hypotheses that differ by symmetry elements agree. Each is brought to the equivalent nearest to the
    current mean (so nothing is averaged across elements), weighted by how near that is, and averaged in the
    chordal metric; the climb starts at several hypotheses and the one with the most support wins.

    Args:
        R: (..., n, 3, 3) hypotheses in no particular order, part → camera.
        weight: (..., n) trust, non-negative, some positive. symmetry: the part's proper group.
        width: angle at which a hypothesis no longer counts, radians.
    Returns:
        (..., 3, 3).
    Note:
        For a revolution the turn about the axis is arbitrary, for a sphere the whole rotation.
    """
    starts = _starts(R, weight)
    some, trust = R[..., :SUPPORTERS, :, :], weight[..., None, :SUPPORTERS]
    support = (trust * _nearness(some, starts, symmetry, 2 * width)[1]).sum(-1)
    best = support.argmax(-1)[..., None, None, None].expand(*support.shape[:-1], 1, 3, 3)
    mean = starts.gather(-3, best)
    for shrink in torch.linspace(2.0, 1.0, ROUNDS).tolist():
        aligned, near = _nearness(R, mean, symmetry, shrink * width)
        pull = weight[..., None, :] * near
        # a start with no company keeps its place
        total = (pull[..., None, None] * aligned).sum(-3) + 1e-12 * mean
        mean = roma.special_procrustes(total)
    return mean.squeeze(-3)


def _starts(R: Tensor, weight: Tensor) -> Tensor:
    """(..., s, 3, 3) of the hypotheses with weight the better half, thinned out evenly."""
    order = torch.argsort(weight, dim=-1, descending=True, stable=True)
    half = ((weight > 0).sum(-1, keepdim=True) + 1) // 2
    share = torch.linspace(0, 1, STARTS, device=weight.device)
    index = order.gather(-1, (share * (half - 1).clamp(min=0)).round().long())
    return R.gather(-3, index[..., None, None].expand(*index.shape, 3, 3))


def _nearness(R: Tensor, mean: Tensor, symmetry: Symmetry, width: float) -> tuple[Tensor, Tensor]:
    """Hypotheses aligned to every mean (..., s, n, 3, 3), and Tukey's weight of their angle (..., s, n)."""
    reference = mean[..., :, None, :, :]
    aligned = nearest_equivalent(R[..., None, :, :, :], reference, symmetry)
    # ‖A − B‖ of rotations an angle θ apart is √8 sin(θ / 2)
    half_sine = (aligned - reference).square().sum((-2, -1)).sqrt() / math.sqrt(8.0)
    return aligned, (1 - (half_sine / math.sin(min(width, math.pi) / 2)).square()).clamp(min=0).square()
