"""The loss of ParametricNet (equations 2 to 5 and 7)."""

from enum import StrEnum
from typing import Any, Protocol

import torch
from torch import Tensor

from pnet.parts.base import ParametricPart
from pnet.records import Batch, PointPrediction

AMBIGUOUS = 1e-3  # metres: a label whose runner-up is nearer than this may well have been the other one


class Norm(StrEnum):
    """How an error vector becomes a number."""

    SQUARED = "squared"  # mean ‖e‖², as the paper prints equations 3 and 4
    DISTANCE = "distance"  # mean ‖e‖ of the 3m-vector, as the released code has it
    EACH = "each"  # mean ‖e_j‖ of every keypoint by itself: one that is ambiguous cannot drown the others


class Loss(Protocol):
    """What a method's training minimises."""

    def __call__(self, predicted: Any, batch: Batch) -> dict[str, Tensor]:
        """ "loss", and its terms by name; scalars. predicted: what the method's network returns."""
        ...

    def remarks(self, batch: Batch) -> dict[str, Tensor]:
        """What else is worth a curve, by its tag; scalars."""
        ...


class ParametricLoss:
    """Weighted sum of the losses of the modules (equation 2).

    Args:
        part: whose keypoints give the parameters (M_P).
        norm: for centroids and keypoints.
        margin: metres; a keypoint label that is no better than its runner-up by much more than this counts
            less, by margin_of_label / (margin_of_label + margin). None: every label counts alike.
        centroid, keypoints, parameters, visibility: the weights λ; None takes the paper's default,
            λ_MC = 200, λ_MKP = 200 / 3m, λ_MP = 50 / k, λ_MV = 50.
        sizes: weight of the parameters that a head of their own says, where there is one.
        doubt: weight of what the network says of its own errors, where it says anything.
    """

    def __init__(
        self,
        part: ParametricPart,
        norm: str,
        margin: float | None = None,
        centroid: float | None = None,
        keypoints: float | None = None,
        parameters: float | None = None,
        visibility: float | None = None,
        sizes: float = 0.0,
        doubt: float = 0.0,
    ) -> None:
        chain = part.chain
        m, k = len(chain), len(chain.parameters)
        if margin is not None and margin <= 0:
            raise ValueError(f"loss.margin is {margin}, expected a positive length in metres or null")
        self._chain, self._norm, self._margin = chain, Norm(norm), margin
        given = {
            "centroid": (centroid, 200.0),
            "keypoints": (keypoints, 200.0 / (3 * m)),
            "parameters": (parameters, 50.0 / k),
            "visibility": (visibility, 50.0),
        }
        self.weights = {name: own if own is not None else paper for name, (own, paper) in given.items()}
        self.weights |= {"sizes": sizes, "doubt": doubt}

    def __call__(self, predicted: PointPrediction, batch: Batch) -> dict[str, Tensor]:
        """Losses of a batch.

        Returns:
            "loss" (the weighted sum) and each module's unweighted loss by name; scalars.
        """
        keypoints = predicted.keypoints
        if batch.lookalike is not None:
            keypoints = self._chain.exchanged(keypoints, batch.lookalike)
        parameters = self._chain.parameters_from_keypoints(predicted.centroid, keypoints)
        losses = {
            "centroid": self._length(predicted.centroid - batch.centroid),
            "keypoints": self._keypoints(predicted.keypoints - batch.keypoints, batch.margin),
            "parameters": (parameters - batch.parameters).abs().sum(-1).mean(),
        }
        if predicted.visibility is not None:
            losses["visibility"] = (predicted.visibility - batch.visibility).abs().mean()
        if predicted.parameters is not None:
            parameters = predicted.parameters
            losses["sizes"] = (parameters - batch.parameters).abs().sum(-1).mean()
        if predicted.doubt is not None:
            losses["doubt"] = doubt_loss(predicted, parameters, batch)
        total = torch.stack([self.weights[name] * loss for name, loss in losses.items()]).sum()
        return {"loss": total, **losses}

    def remarks(self, batch: Batch) -> dict[str, Tensor]:
        """By keypoint the share of its labels whose runner-up is less than `AMBIGUOUS` worse."""
        share = (batch.margin < AMBIGUOUS).float().mean((0, 1))
        names = (f"ambiguous_labels/{name}" for name in self._chain.names)
        return dict(zip(names, share.unbind(), strict=True))

    def _keypoints(self, error: Tensor, margin: Tensor) -> Tensor:
        squared = error.square().sum(-1)
        if self._margin is not None:
            trust = 1 / (1 + self._margin / margin)
            squared = squared * (trust if self._norm is Norm.SQUARED else trust.square())
        if self._norm is Norm.EACH:
            return self._mean(squared) * error.shape[-2]
        return self._mean(squared.sum(-1))

    def _length(self, error: Tensor) -> Tensor:
        return self._mean(error.square().sum(-1))

    def _mean(self, squared: Tensor) -> Tensor:
        if self._norm is Norm.SQUARED:
            return squared.mean()
        # the root's slope is infinite at zero: a nanometre of slack keeps it finite
        return (squared + 1e-18).sqrt().mean()


def doubt_loss(predicted: PointPrediction, parameters: Tensor, batch: Batch) -> Tensor:
    """How badly a network knows its own errors: mean of e / b + log (b / 1 mm).

    That is the negative log-likelihood of an exponentially distributed error e under the expectation b
    (Kendall and Gal, NeurIPS 2017, with a Laplace distribution); least where b is the mean error of points
    that look alike. The errors are taken as given: doubt must not keep a network from learning.

    Args:
        predicted: with `doubt`. parameters: (B, N, k) those predicted, metres.
    """
    assert predicted.doubt is not None
    with torch.no_grad():
        places = torch.cat([predicted.centroid[..., None, :], predicted.keypoints], -2)
        truth = torch.cat([batch.centroid[..., None, :], batch.keypoints], -2)
        off = torch.linalg.vector_norm(places - truth, dim=-1)
        error = torch.cat([off, (parameters - batch.parameters).abs()], -1)
    return (error / predicted.doubt + (predicted.doubt / 1e-3).log()).mean()
