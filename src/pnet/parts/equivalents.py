"""The equivalent keypoints R(kp) of Fig. 4: a primitive's own freedom, carried through the part's
symmetry."""

import torch
from torch import Tensor

from pnet.geometry.constants import converted
from pnet.parts.primitives import Freedom, Primitive


def along_and_radial(primitive: Primitive, step: Tensor) -> tuple[Tensor, Tensor]:
    """A step's fixed and its free share: along the axis of a TURN and off it; all of a NONE; none of a
    SPHERE."""
    match primitive.freedom:
        case Freedom.NONE:
            return step, torch.zeros_like(step)
        case Freedom.SPHERE:
            return torch.zeros_like(step), step
    axis = converted(primitive.axis, step)
    along = (step @ axis)[..., None] * axis
    return along, step - along


def distinct_images(primitive: Primitive, steps: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
    """Which symmetry elements move a keypoint, seen from its reference, to different places.

    Args:
        steps: (n, 3) from the reference, for several sizes. group: (g, 3, 3).
    Returns:
        images (q, 3, 3): one element for each place; member (g,): which of them every element equals.
    """
    unit = steps / torch.linalg.vector_norm(steps, dim=-1, keepdim=True)
    along, _ = along_and_radial(primitive, unit)
    mark = (group @ along.mT).flatten(1)
    if primitive.freedom is Freedom.TURN:  # the circle's plane counts too
        axis = group @ primitive.axis.to(group)
        mark = torch.cat([mark, (axis[:, :, None] * axis[:, None, :]).flatten(1)], 1)
    same = (mark[:, None] - mark[None]).abs().amax(-1) < 1e-6
    first = same.to(torch.uint8).argmax(1)
    kept = torch.unique(first)
    return group[kept], torch.searchsorted(kept, first)


def images_of(vectors: Tensor, images: Tensor) -> Tensor:
    """(..., 3) vectors carried by every one of (q, 3, 3): (..., q, 3)."""
    return (vectors @ images.flatten(0, 1).mT).unflatten(-1, (len(images), 3))


def allowed(alive: Tensor | None, member: Tensor, like: Tensor) -> Tensor:
    """(..., q) images that some symmetry element still alive (..., g) makes."""
    if alive is None:
        return torch.ones_like(like, dtype=torch.bool)
    owns = torch.nn.functional.one_hot(member, like.shape[-1]).to(like)
    return (alive.to(like) @ owns) > 0
