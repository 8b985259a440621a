"""How far estimated keypoints are from the nearest of the true keypoints' equivalents."""

import torch
from torch import Tensor

from pnet.geometry.rigid import apply_inverse_pose
from pnet.parts.equivalents import along_and_radial
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Freedom


def keypoint_error(
    chain: KeypointChain, parameters: Tensor, R: Tensor, t: Tensor, keypoints: Tensor
) -> Tensor:
    """Distances to the nearest equivalents, each keypoint's by itself.

    Args:
        chain: m keypoints. parameters: (n, k) true ones, metres. R: (n, 3, 3), t: (n, 3) true poses, part →
            camera. keypoints: (n, m, 3) estimated, camera frame, metres; NaN where a method has none.
    Returns:
        (n, m) metres; NaN where the keypoints are.
    Note:
        Where a keypoint hangs on one that is free on a circle or sphere, that one is taken where it was
        estimated.
    """
    if keypoints.shape[1:] != (len(chain), 3):
        return torch.full((len(keypoints), len(chain)), torch.nan, dtype=torch.float64)
    template = chain.keypoints_from_parameters(parameters.double())
    seen = apply_inverse_pose(R.double(), t.double(), keypoints.double())
    # an element moves the template; the estimate is moved back instead, (n, g, m, 3)
    images = seen[:, None] @ chain.group.to(seen)
    gaps = torch.linalg.vector_norm(images - _nearest_places(chain, template[:, None], images), dim=-1)
    return gaps.amin(1)


def _nearest_places(chain: KeypointChain, template: Tensor, seen: Tensor) -> Tensor:
    """(..., m, 3) the template with its free keypoints turned towards those seen (..., m, 3)."""
    places = [torch.zeros_like(seen[..., 0, :])]
    steps = chain.steps(template).unbind(-2)
    for i, (keypoint, step) in enumerate(zip(chain.keypoints, steps, strict=True)):
        start = places[chain.reference[i]]
        if keypoint.primitive.freedom is not Freedom.NONE:
            along, radial = along_and_radial(keypoint.primitive, step)
            towards = along_and_radial(keypoint.primitive, seen[..., i, :] - start)[1]
            length = torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
            radius = torch.linalg.vector_norm(radial, dim=-1, keepdim=True)
            step = along + torch.where(length > 1e-12, radius * towards / length.clamp(min=1e-12), radial)
        places.append(start + step)
    return torch.stack(torch.broadcast_tensors(*places[1:]), -2)
