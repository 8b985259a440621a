"""Mean rotation modulo a symmetry group, robust against outliers."""

import math

import roma
import torch
from torch import Tensor

from pnet.geometry.constants import converted
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry, SphericalSymmetry, Symmetry

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
    if isinstance(symmetry, SphericalSymmetry):
        return starts[..., 0, :, :]
    some, trust = R[..., :SUPPORTERS, :, :], weight[..., None, :SUPPORTERS]
    support = (trust * _nearness(_alignment(some, starts, symmetry)[0], 2 * width)).sum(-1)
    best = support.argmax(-1)[..., None, None, None].expand(*support.shape[:-1], 1, 3, 3)
    mean = starts.gather(-3, best)
    for shrink in torch.linspace(2.0, 1.0, ROUNDS).tolist():
        trace, element = (value.squeeze(-2) for value in _alignment(R, mean, symmetry))
        pull = weight * _nearness(trace, shrink * width)
        mean = _average(R, pull, element, symmetry, mean.squeeze(-3)).unsqueeze(-3)
    return mean.squeeze(-3)


def _starts(R: Tensor, weight: Tensor) -> Tensor:
    """(..., s, 3, 3) of the hypotheses with weight the better half, thinned out evenly."""
    order = torch.argsort(weight, dim=-1, descending=True, stable=True)
    half = ((weight > 0).sum(-1, keepdim=True) + 1) // 2
    share = torch.linspace(0, 1, STARTS, device=weight.device)
    index = order.gather(-1, (share * (half - 1).clamp(min=0)).round().long())
    return R.gather(-3, index[..., None, None].expand(*index.shape, 3, 3))


def _alignment(
    R: Tensor, mean: Tensor, symmetry: FiniteSymmetry | RevolutionSymmetry
) -> tuple[Tensor, Tensor]:
    """Which element brings each hypothesis (..., n, 3, 3) nearest to each mean (..., s, 3, 3).

    Returns:
        trace(meanᵀ R g) (..., s, n); index of g (..., s, n), for a revolution whether it is turned round.
    """
    if isinstance(symmetry, RevolutionSymmetry):
        cosine = mean[..., 2] @ R[..., 2].mT
        turned = (cosine < 0) & symmetry.rotoreflection
        # after the nearest turn about the axis only the angle between the axes is left
        return 1 + 2 * torch.where(turned, -cosine, cosine), turned.long()
    products = R.mT.flatten(-3, -2) @ mean.transpose(-3, -2).flatten(-2)  # Rᵀ mean of every pair
    products = products.unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3)).movedim(-2, -4).flatten(-2)
    best = (products @ converted(symmetry.rotations, R).flatten(-2).mT).max(-1)
    return best.values, best.indices


def _nearness(trace: Tensor, width: float) -> Tensor:
    """Tukey's weight of the angle between rotations A and B, from trace(AᵀB)."""
    square_of_half_sine = (3 - trace) / 4
    return (1 - square_of_half_sine / math.sin(min(width, math.pi) / 2) ** 2).clamp(0, 1).square()


def _average(
    R: Tensor, pull: Tensor, element: Tensor, symmetry: FiniteSymmetry | RevolutionSymmetry, old: Tensor
) -> Tensor:
    """(..., 3, 3) chordal mean of the R g by weight (..., n); where there is none the old mean."""
    if isinstance(symmetry, RevolutionSymmetry):
        signed = pull * (1 - 2 * element)
        axis = (signed[..., None, :] @ R[..., 2]).squeeze(-2)
        return _tilted(old, torch.nn.functional.normalize(axis + 1e-12 * old[..., 2], dim=-1))
    G = converted(symmetry.rotations, R)
    # first the sum of those with the same element, then the elements
    shares = pull.new_zeros(*pull.shape, len(G)).scatter(-1, element[..., None], pull[..., None])
    sums = (shares.mT @ R.flatten(-2)).unflatten(-1, (3, 3))
    return roma.special_procrustes((sums @ G).sum(-3) + 1e-12 * old)


def _tilted(R: Tensor, axis: Tensor) -> Tensor:
    """R (..., 3, 3) turned the shortest way that brings its z to the unit vectors (..., 3)."""
    middle = R[..., 2] + axis
    share = (axis[..., None, :] @ R[..., :2]) / (R[..., 2] * middle).sum(-1)[..., None, None]
    return torch.cat([R[..., :2] - middle[..., None] * share, axis[..., None]], -1)
