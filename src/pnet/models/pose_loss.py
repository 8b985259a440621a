"""The loss of PPR-Net: centroid, symmetry-aware rotation and visibility."""

from enum import StrEnum

import torch
from torch import Tensor

from pnet.geometry.constants import converted
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry
from pnet.parts.base import ParametricPart
from pnet.records import Batch, PosePrediction


class RotationNorm(StrEnum):
    """How a rotation's error becomes a number."""

    ENTRIES = "entries"  # Σ|e|, the released code's; has a local minimum where an axis points the wrong way
    DISTANCE = "distance"  # ‖e‖, Brégier's distance; falls all the way


class PoseLoss:
    """Weighted sum of three absolute errors; what a hidden body is taught counts less.

    The rotation's error is the size of (R − R̂ g) Λ with the symmetry element g of the part for which it is
    smallest; for a revolution that of λ (R − R̂ g) e_z. The part declares its symmetry.

    Args:
        part: whose symmetry counts.
        norm: how the matrix (R − R̂ g) Λ, or the axis' error, becomes a length; see `RotationNorm`.
        centroid, rotation, visibility: the weights, for lengths in metres; the released code has 200, 200 and
            50.
    """

    def __init__(
        self,
        part: ParametricPart,
        norm: str = "distance",
        centroid: float = 200.0,
        rotation: float = 200.0,
        visibility: float = 50.0,
    ) -> None:
        self._part, self._norm = part, RotationNorm(norm)
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
                nearest = self._nearest_equivalent(R, truth, converted(G, R), scale)
                return self._length(((R - nearest) @ scale).flatten(-2))
            case RevolutionSymmetry(rotoreflection=reflected):
                axis, true = R[..., 2], truth[..., 2]
                length = self._length(axis - true)
                if reflected:
                    length = torch.minimum(length, self._length(axis + true))
                return scale[..., 0, 0] * length
            case _:
                return 0 * R.sum((-1, -2))

    @torch.no_grad()
    def _nearest_equivalent(self, R: Tensor, truth: Tensor, G: Tensor, scale: Tensor) -> Tensor:
        """Of the equivalents of the true rotations the nearest to R in the loss's own measure.

        One at a time: all of a large group's at once would take its size times the memory.
        """
        best, least = truth, self._length(((R - truth) @ scale).flatten(-2))
        for g in G[1:]:
            other = truth @ g
            distance = self._length(((R - other) @ scale).flatten(-2))
            nearer = distance < least
            best = torch.where(nearer[..., None, None], other, best)
            least = torch.where(nearer, distance, least)
        return best

    def _length(self, error: Tensor) -> Tensor:
        """(..., c) → (...)."""
        if self._norm is RotationNorm.ENTRIES:
            return error.abs().sum(-1)
        # the root's slope is infinite at zero: a nanometre of slack keeps it finite
        return (error.square().sum(-1) + 1e-18).sqrt()
