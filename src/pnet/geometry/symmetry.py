"""Proper symmetry groups of a rigid body, with the symmetry axis along the body's z.

The four cases are Fig. 4 of the paper: spherical, rotational ("revolution"), finite, none (a finite
group of one element).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class FiniteSymmetry:
    """A finite group of proper rotations, among them the identity.

    Attributes:
        rotations: (g, 3, 3) float64, the identity first.
    """

    rotations: Tensor

    def __post_init__(self) -> None:
        G = self.rotations
        if G.ndim != 3 or G.shape[-2:] != (3, 3) or len(G) == 0:
            raise ValueError(f"symmetry rotations have shape {tuple(G.shape)}, expected (g, 3, 3)")
        eye = torch.eye(3, dtype=G.dtype)
        proper = torch.linalg.det(G) > 0
        if not bool(torch.allclose(G @ G.mT, eye.expand_as(G), atol=1e-6) and proper.all()):
            raise ValueError("symmetry rotations must be orthonormal with determinant +1")
        products = (G[:, None] @ G[None]).flatten(0, 1)
        gap = (products[:, None] - G[None]).abs().amax((-1, -2)).amin(1)
        if bool((gap > 1e-5).any()):
            raise ValueError("symmetry rotations are not a group: some product is missing")


@dataclass(frozen=True)
class RevolutionSymmetry:
    """All turns about z; with `rotoreflection` also the half turns that exchange +z and −z."""

    rotoreflection: bool = False


@dataclass(frozen=True)
class SphericalSymmetry:
    """All rotations about the centre."""


Symmetry = FiniteSymmetry | RevolutionSymmetry | SphericalSymmetry


def rotation_about_z(angle: Tensor) -> Tensor:
    """Rotation matrices about z.

    Args:
        angle: (...) radians.
    Returns:
        (..., 3, 3) in the angle's dtype.
    """
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).unflatten(-1, (3, 3))


def cyclic(n: int) -> FiniteSymmetry:
    """C_n: the n turns by 2π/n about z. `cyclic(1)` is "no symmetry"."""
    angles = torch.arange(n, dtype=torch.float64) * (2 * math.pi / n)
    return FiniteSymmetry(rotation_about_z(angles))


def dihedral(n: int) -> FiniteSymmetry:
    """D_n: C_n and the n half turns about axes in the xy plane, one of them x; 2n rotations."""
    turns = cyclic(n).rotations
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    return FiniteSymmetry(torch.cat([turns, turns @ flip]))
