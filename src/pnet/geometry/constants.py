"""Constants beside the data: on its device, in its number type."""

import torch
from torch import Tensor

Kind = tuple[torch.dtype, torch.device]


def converted(constant: Tensor, like: Tensor) -> Tensor:
    """A constant in another tensor's number type and on its device.

    The copy is kept with the constant: a move to a GPU waits until the GPU has done all that it was given.

    Args:
        constant: not changed after its first use here; without a gradient.
    """
    if constant.dtype == like.dtype and constant.device == like.device:
        return constant
    copies: dict[Kind, Tensor] = constant.__dict__.setdefault("converted", {})
    kind = like.dtype, like.device
    if kind not in copies:
        with torch.inference_mode(False):  # a copy made there could not serve a training later
            copies[kind] = constant.to(dtype=like.dtype, device=like.device)
    return copies[kind]
