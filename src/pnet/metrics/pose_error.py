"""How far a result is from the true pose it is matched with: position, axis and parameters."""

import math

import torch
from torch import Tensor

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.rigid import axis_angle_between, rotation_angle
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry


def position_error(space: PoseSpace, Ra: Tensor, ta: Tensor, Rb: Tensor, tb: Tensor) -> Tensor:
    """Distance between the two surface centroids, which no symmetry of the body moves.

    Args:
        Ra, Rb: (..., 3, 3), ta, tb: (..., 3) metres; body → any common frame; they broadcast.
    Returns:
        (...) metres.
    """
    a = ta.double() + Ra.double() @ space.centre
    b = tb.double() + Rb.double() @ space.centre
    return torch.linalg.vector_norm(a - b, dim=-1)


def axis_error(space: PoseSpace, Ra: Tensor, Rb: Tensor) -> Tensor:
    """Angle between two orientations that no symmetry of the body explains.

    A revolution: between the two axes, without their sign under a rotoreflection. A finite group:
    the smallest rotation angle over the group. A sphere: 0.

    Args:
        Ra, Rb: (..., 3, 3), body → any common frame; they broadcast.
    Returns:
        (...) radians.
    """
    Ra, Rb = Ra.double(), Rb.double()
    match space.symmetry:
        case FiniteSymmetry(rotations=G):
            # the group acts in the inertial frame
            a, b = Ra @ space.frame_R.mT, Rb @ space.frame_R.mT
            return rotation_angle(a[..., None, :, :], b[..., None, :, :] @ G).amin(-1)
        case RevolutionSymmetry(rotoreflection=reflected):
            angle = axis_angle_between(*torch.broadcast_tensors(Ra[..., 2], Rb[..., 2]))
            return torch.minimum(angle, math.pi - angle) if reflected else angle
        case _:
            return torch.zeros_like((Ra - Rb)[..., 0, 0])


def parameter_error(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of paired parameters, (n, k) metres in and out."""
    if a.shape != b.shape:
        raise ValueError(
            f"parameters have shapes {tuple(a.shape)} and {tuple(b.shape)}, expected equal (n, k)"
        )
    return (a - b).abs()
