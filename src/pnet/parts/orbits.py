"""Equivalent directions of a keypoint as seen from its reference: the paper's R(kp), Fig. 4.

A keypoint lies at `reference + distance · direction`; its equivalents are the directions that the
primitive's symmetry allows. Every orbit picks the direction nearest to the camera (equation 1).
Directions are unit vectors in the part frame; `view` holds the camera's axes in the part frame.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pnet.geometry.symmetry import rotation_about_z

TIE = 1e-9  # directions closer than this in one coordinate count as equal


class Orbit(Protocol):
    """A set of equivalent directions."""

    @property
    def canonical(self) -> Tensor:
        """(3,) float64 the direction of the template's own keypoint."""
        ...

    def nearest_to_camera(self, view: Tensor) -> Tensor:
        """The direction with the smallest camera z, then y, then x (equation 1).

        Args:
            view: (..., 3, 3) the rotation part → camera; row i is camera axis i in the part frame.
        Returns:
            (..., 3) unit direction in the part frame.
        """
        ...

    def project(self, direction: Tensor) -> Tensor:
        """The orbit's direction that is nearest to a given one.

        Args:
            direction: (..., 3) in the part frame, any length.
        Returns:
            (..., 3) unit direction.
        """
        ...


@dataclass(frozen=True)
class FiniteOrbit:
    """Finitely many directions, the canonical one first: polygon vertices, a pair of faces, one point.

    Attributes:
        directions: (q, 3) float64 unit vectors.
    """

    directions: Tensor

    @property
    def canonical(self) -> Tensor:
        """The first direction."""
        return self.directions[0]

    def nearest_to_camera(self, view: Tensor) -> Tensor:
        """Exhaustive comparison, as the paper does for finite sets."""
        directions = self.directions.to(view)
        seen = directions @ view.mT
        candidate = torch.ones(seen.shape[:-1], dtype=torch.bool, device=view.device)
        for axis in (2, 1, 0):
            value = seen[..., axis].masked_fill(~candidate, math.inf)
            candidate = value <= value.amin(-1, keepdim=True) + TIE
        return directions[candidate.to(torch.uint8).argmax(-1)]

    def project(self, direction: Tensor) -> Tensor:
        """The direction with the largest cosine."""
        directions = self.directions.to(direction)
        best: Tensor = directions[(direction @ directions.T).argmax(-1)]
        return best


@dataclass(frozen=True)
class RingOrbit:
    """All directions perpendicular to the part's z axis; the canonical one is x (a cylinder, a circle)."""

    @property
    def canonical(self) -> Tensor:
        """The x axis."""
        return torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def nearest_to_camera(self, view: Tensor) -> Tensor:
        """Closed form: against the view axis, laid into the ring's plane; seen along the axis, y decides."""
        against_z, against_y = -view[..., 2, :2], -view[..., 1, :2]
        tie = torch.linalg.vector_norm(against_z, dim=-1, keepdim=True) <= TIE
        return _in_plane(torch.where(tie, against_y, against_z))

    def project(self, direction: Tensor) -> Tensor:
        """The direction laid into the plane; x where it stands on the plane."""
        flat = direction[..., :2]
        upright = torch.linalg.vector_norm(flat, dim=-1, keepdim=True) <= TIE
        return _in_plane(torch.where(upright, self.canonical[:2].to(flat), flat))


@dataclass(frozen=True)
class SphereOrbit:
    """Every direction; the canonical one is z."""

    @property
    def canonical(self) -> Tensor:
        """The z axis."""
        return torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

    def nearest_to_camera(self, view: Tensor) -> Tensor:
        """Straight against the view axis."""
        return -view[..., 2, :]

    def project(self, direction: Tensor) -> Tensor:
        """The direction itself."""
        return torch.nn.functional.normalize(direction, dim=-1)


def point_orbit(direction: tuple[float, float, float]) -> FiniteOrbit:
    """One direction without equivalents."""
    unit = torch.tensor([direction], dtype=torch.float64)
    return FiniteOrbit(torch.nn.functional.normalize(unit, dim=-1))


def pair_orbit(direction: tuple[float, float, float]) -> FiniteOrbit:
    """A direction and its opposite: the two end faces of a mirror-symmetric part."""
    one = point_orbit(direction).directions
    return FiniteOrbit(torch.cat([one, -one]))


def polygon_orbit(n: int) -> FiniteOrbit:
    """The n vertices of a regular polygon about z, the first on x."""
    turns = rotation_about_z(torch.arange(n, dtype=torch.float64) * (2 * math.pi / n))
    return FiniteOrbit(turns[:, :, 0].contiguous())


def _in_plane(flat: Tensor) -> Tensor:
    unit = torch.nn.functional.normalize(flat, dim=-1)
    return torch.cat([unit, torch.zeros_like(unit[..., :1])], -1)
