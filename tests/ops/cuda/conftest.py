"""The CUDA kernels on a card where there is one, else on the CPU in Triton's interpreter."""

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def on_device(value):
    """A tensor where the kernels run; anything else as it is."""
    return value.to(DEVICE) if isinstance(value, Tensor) else value


@pytest.fixture
def here():
    """Brings tensors to where the kernels run."""
    return on_device
