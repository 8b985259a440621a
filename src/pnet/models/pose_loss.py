"""The loss of PPR-Net: centroid, symmetry-aware rotation and visibility."""

import torch
from torch import Tensor

from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry
from pnet.parts.base import ParametricPart
from pnet.records import Batch, PosePrediction


class PoseLoss:
    """Weighted sum of three absolute errors; what a hidden body is taught counts less.

    The rotation's error is the sum of the entries of |(R − R̂ g) Λ| with the symmetry element g of the part
    for which it is smallest; for a revolution that of λ (R − R̂ g) e_z. The part declares its symmetry.

    Args:
        part: whose symmetry counts.
        centroid, rotation, visibility: the weights, for lengths in metres; the released code has 200, 200 and
            50.
    """

    def __init__(
        self, part: ParametricPart, centroid: float = 200.0, rotation: float = 200.0, visibility: float = 50.0
    ) -> None:
        self._part = part
        self.weights = {"centroid": centroid, "rotation": rotation, "visibility": visibility}

    def __call__(self, predicted: PosePrediction, batch: Batch) -> dict[str, Tensor]:
        """Losses of a batch.

        Args:
            batch: with the labels `rotation` and `scale` (data.targets.poses=true).
        Returns:
            "loss" (the weighted sum) and each head's unweighted loss by name; scalars.
        """
        if batch.rotation is None or batch.scale is None:
            raise ValueError("the labels hold no rotations: set data.targets.poses=true (method=pprnet does)")
        distance = self._rotation_distance(predicted.rotation, batch.rotation, batch.scale[:, None])
        position = (predicted.centroid - batch.centroid).abs().sum(-1)
        losses = {
            "centroid": (batch.visibility * position).mean(),
            "rotation": (batch.visibility * distance).mean(),
        }
        if predicted.visibility is not None:
            losses["visibility"] = (predicted.visibility - batch.visibility).abs().mean()
        total = torch.stack([self.weights[name] * loss for name, loss in losses.items()]).sum()
        return {"loss": total, **losses}

    def remarks(self, batch: Batch) -> dict[str, Tensor]:
        """Nothing beside the losses is worth a curve."""
        return {}

    def _rotation_distance(self, R: Tensor, truth: Tensor, scale: Tensor) -> Tensor:
        """(...) metres; R, truth: (..., 3, 3); scale: (..., 3, 3) Λ, broadcast against them."""
        match self._part.symmetry:
            case FiniteSymmetry(rotations=G):
                nearest = _nearest_equivalent(R, truth, G.to(R), scale)
                return ((R - nearest) @ scale).abs().sum((-1, -2))
            case RevolutionSymmetry(rotoreflection=reflected):
                axis, true = R[..., 2], truth[..., 2]
                if reflected:
                    true = torch.where((axis * true).sum(-1, keepdim=True) < 0, -true, true)
                return scale[..., 0, 0] * (axis - true).abs().sum(-1)
            case _:
                return 0 * R.sum((-1, -2))


@torch.no_grad()
def _nearest_equivalent(R: Tensor, truth: Tensor, G: Tensor, scale: Tensor) -> Tensor:
    """Of the equivalents of the true rotations the nearest to R in the loss's own measure.

    One at a time: all of a large group's at once would take its size times the memory.
    """
    best, least = truth, ((R - truth) @ scale).abs().sum((-1, -2))
    for g in G[1:]:
        other = truth @ g
        distance = ((R - other) @ scale).abs().sum((-1, -2))
        nearer = distance < least
        best = torch.where(nearer[..., None, None], other, best)
        least = torch.where(nearer, distance, least)
    return best
