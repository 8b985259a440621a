"""Proper symmetry groups of a rigid body, with the symmetry axis along the body's z.

The four cases are Fig. 4 of the paper: spherical, rotational ("revolution"), finite, none (a finite
group of one element).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.geometry.constants import converted


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
        if not _is_closed(G):
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


FLIP = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))  # half turn about x
_HALF_TURN = torch.tensor(FLIP, dtype=torch.float64)


def reflection(normal: tuple[float, float, float]) -> Tensor:
    """(3, 3) float64: mirror in the plane through the origin with this normal."""
    n = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    return torch.eye(3, dtype=torch.float64) - 2 * torch.outer(n, n)


def full_group(symmetry: Symmetry, mirror: Tensor | None = None) -> Tensor:
    """Every symmetry of a body, reflections too, up to turns about a revolution's axis or a sphere's centre.

    Args:
        symmetry: the proper ones. mirror: (3, 3) one improper symmetry, or None where there is none. A
            revolution's and a sphere's need not be named: together with the turns they move no point that
            the proper ones do not move there.
    Returns:
        (g, 3, 3) float64, the identity first, proper before improper.
    """
    eye = torch.eye(3, dtype=torch.float64)
    match symmetry:
        case FiniteSymmetry(rotations=G):
            return G if mirror is None else torch.cat([G, _mirrored(G, mirror)])
        case RevolutionSymmetry(rotoreflection=True):
            group = torch.stack([eye, _HALF_TURN])
        case _:
            group = eye[None]
    if mirror is not None:
        raise ValueError("a mirror adds nothing to a revolution or a sphere: leave it out")
    return group


def _mirrored(G: Tensor, mirror: Tensor) -> Tensor:
    M = mirror.to(G)
    if M.shape != (3, 3) or not torch.allclose(M @ M.mT, torch.eye(3).to(G)) or torch.linalg.det(M) > 0:
        raise ValueError("the mirror must be an orthonormal (3, 3) matrix with determinant -1")
    whole = torch.cat([G, G @ M])
    if not _is_closed(whole):
        raise ValueError("the mirror and the symmetry's rotations are not a group together")
    return G @ M


def _is_closed(elements: Tensor) -> bool:
    """Whether every product of two of the (g, 3, 3) elements is one of them."""
    products = (elements[:, None] @ elements[None]).flatten(0, 1)
    gap = (products[:, None] - elements[None]).abs().amax((-1, -2)).amin(1)
    return bool((gap <= 1e-5).all())


def nearest_equivalent(R: Tensor, reference: Tensor, symmetry: Symmetry) -> Tensor:
    """Of the equivalent rotations R g the one nearest to a reference.

    Args:
        R, reference: (..., 3, 3) part → camera, broadcast against each other.
        symmetry: the part's proper group.
    Returns:
        (..., 3, 3) R g with the smallest angle to the reference.
    """
    R, reference = torch.broadcast_tensors(R, reference)
    match symmetry:
        case FiniteSymmetry(rotations=rotations):
            G = converted(rotations, R)
            closeness = (R.mT @ reference).flatten(-2) @ G.flatten(-2).mT  # trace(referenceᵀ R g)
            return R @ G[closeness.argmax(-1)]
        case RevolutionSymmetry(rotoreflection=reflected):
            turned = _turn_nearest(R, reference)
            if not reflected:
                return turned
            flipped = _turn_nearest(R @ converted(_HALF_TURN, R), reference)
            axis = reference[..., 2]
            nearer = (flipped[..., 2] * axis).sum(-1) > (turned[..., 2] * axis).sum(-1)
            return torch.where(nearer[..., None, None], flipped, turned)
        case _:
            return reference


def _turn_nearest(R: Tensor, reference: Tensor) -> Tensor:
    """R turned about its own z to come nearest to the reference: maximise trace(referenceᵀ R Rz(φ))."""
    A = reference.mT @ R
    angle = torch.atan2(A[..., 0, 1] - A[..., 1, 0], A[..., 0, 0] + A[..., 1, 1])
    return R @ rotation_about_z(angle)
