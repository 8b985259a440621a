"""How much of a batch is recovered at once, and which of its points say anything."""

from collections.abc import Callable
from dataclasses import replace
from operator import itemgetter
from typing import TypeVar

import torch
from torch import Tensor

from pnet.postprocess.kernels import Kernels, kernels_for
from pnet.records import Detections, PointPrediction, PosePrediction

Prediction = TypeVar("Prediction", PointPrediction, PosePrediction)


def in_batches(
    recover: Callable[[Prediction, Tensor | None], list[Detections]],
    prediction: Prediction,
    points: Tensor | None,
) -> list[Detections]:
    """Detections of every scene: of all at once on a GPU, which one scene does not fill, else one by one.

    A scene by itself is rounded by itself: matrix products depend on how many rows there are.

    Args:
        recover: finds those of several scenes. prediction: of B scenes. points: (B, N, 3) their clouds.
    """
    if prediction.centroid.device.type not in ("cpu", "cuda"):  # others know no double precision
        prediction = _each(prediction, Tensor.cpu)
    if kernels_for(prediction.centroid) is not Kernels.NUMBA:
        return recover(prediction, points)
    found = []
    for i in range(len(prediction.centroid)):
        one = _each(prediction, itemgetter(slice(i, i + 1)))
        found += recover(one, None if points is None else points[i : i + 1])
    return found


def _each(prediction: Prediction, change: Callable[[Tensor], Tensor]) -> Prediction:
    """With every tensor changed."""
    said = {name: value for name, value in vars(prediction).items() if value is not None}
    return replace(prediction, **{name: change(value) for name, value in said.items()})


def sound_points(first: Tensor, *others: Tensor | None) -> Tensor:
    """(B, N) bool: the points of the scenes of which all is finite that is said of them, (B, N, ...) each.

    A network that has diverged finds nothing.
    """
    sound = torch.ones(len(first), dtype=torch.bool, device=first.device)
    for said in (first, *others):
        if said is not None:
            sound = sound & torch.isfinite(said).flatten(1).all(1)
    return sound[:, None].expand(first.shape[:2])
