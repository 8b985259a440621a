"""What the launches of all kernels share."""

from contextlib import AbstractContextManager
from typing import Any

import torch
import triton
from torch import Tensor

EXACT = {"enable_fp_fusion": False}  # a fused a·b + c rounds once: ties would fall differently than elsewhere


def block(size: int, most: int) -> int:
    """Length of a program's block over `size` entries: a power of two, at most `most`."""
    return min(triton.next_power_of_2(max(size, 1)), most)


def on_device_of(tensor: Tensor) -> AbstractContextManager[Any]:
    """Launch on the tensor's own card; nothing to do for the interpreter's tensors on a CPU."""
    return torch.cuda.device_of(tensor)
