"""Which of the equivalent keypoints a point is taught: equation 1 of the paper, and two other rules.

A rule compares places by a cost and settles ties; circles and spheres are solved in closed form.
All places are in the part frame, metres.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from typing import Protocol

import torch
from torch import Tensor

TIE = 1e-10  # costs closer than this count as equal, metres


class KeypointRule(StrEnum):
    """Which of the equivalent keypoints is the label."""

    CAMERA = "camera"  # equation 1: the geometrically unique one (GU), nearest to the camera
    CANONICAL = "canonical"  # the template's own: the ablation "w/o GU"
    POINT = "point"  # nearest to the surface point that is taught; votes must be folded


class Judge(Protocol):
    """Compares equivalent keypoints for one rule; leading dimensions (...) are instances or points."""

    def keys(self, places: Tensor) -> list[Tensor]:
        """Costs by which places are compared, the first first, the next on a tie.

        Args:
            places: (..., q, 3).
        Returns:
            Tensors (..., q), metres.
        """
        ...

    def on_circle(self, centre: Tensor, normal: Tensor, towards: Tensor) -> Tensor:
        """Direction from a circle's centre to its point of least cost.

        Args:
            centre: (..., q, 3). normal: (q, 3) of the circle's plane, unit. towards: (q, 3) unit
                directions in the plane, taken where every point is as good.
        Returns:
            (..., q, 3) unit.
        """
        ...

    def on_sphere(self, centre: Tensor) -> Tensor:
        """Direction from a sphere's centre (..., 3) to its point of least cost: (..., 3) unit."""
        ...


@dataclass(frozen=True)
class NearestToCamera:
    """Equation 1: smallest z in the camera frame, then smallest y, then smallest x.

    Attributes:
        view: (..., 3, 3) rotation part → camera; row i is camera axis i in the part frame.
    """

    view: Tensor

    def keys(self, places: Tensor) -> list[Tensor]:
        """z, y and x in the camera's orientation."""
        seen = places @ self.view.mT
        return [seen[..., 2], seen[..., 1], seen[..., 0]]

    def on_circle(self, centre: Tensor, normal: Tensor, towards: Tensor) -> Tensor:
        """Against the view axis, laid into the plane; where that stands upright, against y."""
        upwards = [-self.view[..., None, axis, :] for axis in (2, 1)]
        against_z, against_y = (_laid(direction, normal) for direction in upwards)
        upright = torch.linalg.vector_norm(against_z, dim=-1, keepdim=True) <= 1e-9
        return torch.nn.functional.normalize(torch.where(upright, against_y, against_z), dim=-1)

    def on_sphere(self, centre: Tensor) -> Tensor:
        """Straight against the view axis."""
        return -self.view[..., 2, :]


@dataclass(frozen=True)
class NearestToPoint:
    """The equivalent keypoint nearest to a surface point: local, so easy to learn.

    Attributes:
        points: (..., 3) surface points in the part frame.
    """

    points: Tensor

    def keys(self, places: Tensor) -> list[Tensor]:
        """Distances to the point."""
        return [torch.linalg.vector_norm(places - self.points[..., None, :], dim=-1)]

    def on_circle(self, centre: Tensor, normal: Tensor, towards: Tensor) -> Tensor:
        """Towards the point, laid into the plane; the template's own where the point is on the axis."""
        direction = _laid(self.points[..., None, :] - centre, normal)
        length = torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
        return torch.where(length > TIE, direction / length.clamp(min=TIE), towards.expand_as(direction))

    def on_sphere(self, centre: Tensor) -> Tensor:
        """Towards the point; z where it is the centre."""
        direction = self.points - centre
        length = torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
        upwards = torch.tensor([0.0, 0.0, 1.0]).to(direction).expand_as(direction)
        return torch.where(length > TIE, direction / length.clamp(min=TIE), upwards)


def first_by(keys: list[Tensor], allowed: Tensor) -> tuple[Tensor, Tensor]:
    """The allowed candidate of least cost, and its lead.

    Args:
        keys: tensors (..., q), compared in turn. allowed: (..., q) bool, some True in each row.
    Returns:
        index (...) int64, and margin (...): how much the runner-up's first key is larger, metres; infinite
        where there is no other candidate.
    """
    candidate = allowed.expand(keys[0].shape)
    for key in keys:
        value = key.masked_fill(~candidate, torch.inf)
        candidate = value <= value.amin(-1, keepdim=True) + TIE
    index = candidate.to(torch.uint8).argmax(-1)
    cost = keys[0].masked_fill(~allowed, torch.inf)
    best = cost.gather(-1, index[..., None])
    margin = (cost.scatter(-1, index[..., None], torch.inf) - best).amin(-1)
    return index, margin.clamp(min=0)


@dataclass(frozen=True)
class KeypointChoice:
    """A rule, and the direction along which the camera rule compares.

    Attributes:
        rule: which equivalent is the label.
        direction: camera-frame vector; the label is the equivalent that lies least far along it. The
            paper's equation 1 has (0, 0, 1). Seen along its axis a ring has no nearest point under that,
            and most flat parts lie so: an oblique or upright direction moves the ambiguity to rare views.
    """

    rule: KeypointRule = KeypointRule.CAMERA
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if len(self.direction) != 3 or not any(self.direction) or not all(map(isfinite, self.direction)):
            raise ValueError(f"targets.direction is {self.direction}, expected three numbers, not all zero")

    @property
    def frame(self) -> Tensor:
        """(3, 3) float64 rotation whose rows are the x, y and z of equation 1 and its tie-breaks."""
        z = torch.nn.functional.normalize(torch.tensor(self.direction, dtype=torch.float64), dim=0)
        x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        if abs(float(z[0])) > 0.9:  # x would be nearly along z: start from another axis
            x = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        x = torch.nn.functional.normalize(x - (x @ z) * z, dim=0)
        return torch.stack([x, torch.linalg.cross(z, x), z])


def _laid(direction: Tensor, normal: Tensor) -> Tensor:
    """Directions without their component along the unit normal."""
    return direction - (direction * normal).sum(-1, keepdim=True) * normal
