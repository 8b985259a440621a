"""The loss of ParametricNet (equations 2 to 5 and 7)."""

from enum import StrEnum

import torch
from torch import Tensor

from pnet.parts.keypoints import KeypointChain
from pnet.records import Batch, PointPrediction


class Norm(StrEnum):
    """How an error vector becomes a number."""

    SQUARED = "squared"  # mean ‖e‖², as the paper prints equations 3 and 4
    DISTANCE = "distance"  # mean ‖e‖ of the 3m-vector, as the released code has it
    EACH = "each"  # mean ‖e_j‖ of every keypoint by itself: one that is ambiguous cannot drown the others


class ParametricLoss:
    """Weighted sum of the losses of the modules (equation 2).

    Args:
        chain: the part's keypoints, for M_P.
        norm: for centroids and keypoints.
        centroid, keypoints, parameters, visibility: the weights λ; None takes the paper's default,
            λ_MC = 200, λ_MKP = 200 / 3m, λ_MP = 50 / k, λ_MV = 50.
    """

    def __init__(
        self,
        chain: KeypointChain,
        norm: str,
        centroid: float | None = None,
        keypoints: float | None = None,
        parameters: float | None = None,
        visibility: float | None = None,
    ) -> None:
        m, k = len(chain), len(chain.parameters)
        self._chain, self._norm = chain, Norm(norm)
        given = {
            "centroid": (centroid, 200.0),
            "keypoints": (keypoints, 200.0 / (3 * m)),
            "parameters": (parameters, 50.0 / k),
            "visibility": (visibility, 50.0),
        }
        self.weights = {name: own if own is not None else paper for name, (own, paper) in given.items()}

    def __call__(self, predicted: PointPrediction, batch: Batch) -> dict[str, Tensor]:
        """Losses of a batch.

        Returns:
            "loss" (the weighted sum) and each module's unweighted loss by name; scalars.
        """
        parameters = self._chain.parameters_from_keypoints(predicted.centroid, predicted.keypoints)
        losses = {
            "centroid": self._length(predicted.centroid - batch.centroid),
            "keypoints": self._keypoints(predicted.keypoints - batch.keypoints),
            "parameters": (parameters - batch.parameters).abs().sum(-1).mean(),
        }
        if predicted.visibility is not None:
            losses["visibility"] = (predicted.visibility - batch.visibility).abs().mean()
        total = torch.stack([self.weights[name] * loss for name, loss in losses.items()]).sum()
        return {"loss": total, **losses}

    def _keypoints(self, error: Tensor) -> Tensor:
        if self._norm is Norm.EACH:
            return self._length(error) * error.shape[-2]
        return self._length(error.flatten(-2))

    def _length(self, error: Tensor) -> Tensor:
        squared = error.square().sum(-1)
        if self._norm is Norm.SQUARED:
            return squared.mean()
        # the root's slope is infinite at zero: a nanometre of slack keeps it finite
        return (squared + 1e-18).sqrt().mean()
