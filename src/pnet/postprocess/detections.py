"""From the instances of a batch to each scene's detections on the CPU."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pnet.parts.base import ParametricPart
from pnet.records import Detections

LEFT_OUT = -1.0  # in place of the score of an instance that is seen too little of


def on_cpu(found: Detections) -> Detections:
    """All of it on the CPU: the instances' small fields in one transfer, the points' numbers in another."""
    columns = found.R, found.t, found.parameters, found.score, found.keypoints
    wide = [column.shape[1:].numel() for column in columns]
    flat = [column.reshape(-1, width) for column, width in zip(columns, wide, strict=True)]
    parts = zip(torch.cat(flat, 1).cpu().split(wide, 1), columns, strict=True)
    R, t, parameters, score, keypoints = (part.reshape(column.shape) for part, column in parts)
    return Detections(R, t, parameters, score, keypoints, found.instance.cpu())


def by_scene(found: Detections, keep: Tensor, scenes: Sequence[int]) -> list[Detections]:
    """Each scene's kept detections, best first.

    Args:
        found: (d) of all scenes, one scene's after the other's; their points' (B, N) instances by these
            numbers. keep: (d,) bool. scenes: how many each has, B numbers.
    """
    fields = (found.R, found.t, found.parameters, found.score, found.keypoints, keep)
    rows = zip(*(field.split(list(scenes)) for field in fields), strict=True)
    first, split = 0, []
    for own, instance, d in zip(rows, found.instance, scenes, strict=True):
        R, t, parameters, score, keypoints, kept = own
        numbers = torch.where(instance >= 0, instance - first, -1)
        split.append(best_first(Detections(R, t, parameters, score, keypoints, numbers), kept))
        first += d
    return split


def best_first(found: Detections, keep: Tensor) -> Detections:
    """The kept detections by falling score; their points' cluster numbers follow, others become −1."""
    order = torch.argsort(found.score, descending=True, stable=True)
    order = order[keep[order]]
    place = torch.full((len(keep) + 1,), -1)  # the last entry serves label −1
    place[order] = torch.arange(len(order))
    return Detections(
        found.R[order],
        found.t[order],
        found.parameters[order],
        found.score[order],
        found.keypoints[order],
        place[found.instance],
    )


def no_detections(part: ParametricPart, points: int) -> Detections:
    """Nothing found in a scene of so many points."""
    empty = torch.zeros(0, 3, 3, dtype=torch.float64)
    return Detections(
        R=empty,
        t=empty[:, 0],
        parameters=torch.zeros(0, part.k, dtype=torch.float64),
        score=torch.zeros(0, dtype=torch.float64),
        keypoints=torch.zeros(0, len(part.chain), 3, dtype=torch.float64),
        instance=torch.full((points,), -1),
    )
