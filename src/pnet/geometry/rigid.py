"""Rigid transforms of points and poses: x' = R x + t."""

import roma
import torch
from torch import Tensor


def apply_pose(R: Tensor, t: Tensor, points: Tensor) -> Tensor:
    """Carry points through a pose.

    Args:
        R: (..., 3, 3) rotation.
        t: (..., 3) translation, metres.
        points: (..., n, 3) in the source frame, metres.
    Returns:
        (..., n, 3) R x + t in the target frame, metres.
    """
    return points @ R.transpose(-1, -2) + t[..., None, :]


def apply_inverse_pose(R: Tensor, t: Tensor, points: Tensor) -> Tensor:
    """Carry points back through a pose: Rᵀ (x − t). Shapes as in `apply_pose`."""
    return (points - t[..., None, :]) @ R


def fit_rigid(source: Tensor, target: Tensor, weight: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Least-squares rotation and translation of `source` onto `target` (Arun et al., the paper's eq. 6).

    Args:
        source: (..., n, 3) points, metres; n >= 3, not collinear.
        target: (..., n, 3) the same points in the target frame, metres.
        weight: (..., n) non-negative, or None for equal weights.
    Returns:
        R (..., 3, 3) with det +1, t (..., 3) metres: target ≈ R source + t.
    Note:
        Coplanar points leave the reflection to the determinant's sign, not to the data.
        Collinear points leave the turn about their line free: some rotation that fits is returned.
    """
    R, t = roma.rigid_points_registration(source, target, weights=weight)
    return R, t


def rotation_angle(Ra: Tensor, Rb: Tensor) -> Tensor:
    """Angle in radians between two rotations.

    Args:
        Ra, Rb: (..., 3, 3) rotations.
    Returns:
        (...) angle in [0, π].
    """
    return roma.rotmat_geodesic_distance(Ra, Rb)


def axis_angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Angle in radians between two directions, exact also for small angles.

    Args:
        a, b: (..., 3) non-zero vectors.
    Returns:
        (...) angle in [0, π].
    """
    sine = torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1)
    cosine = (a * b).sum(-1)
    return torch.atan2(sine, cosine)
