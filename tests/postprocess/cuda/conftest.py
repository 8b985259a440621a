"""The CUDA kernels on a card where there is one, else on the CPU in Triton's interpreter."""

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture
def here():
    """Brings tensors to where the kernels run; leaves anything else as it is."""

    def bring(*values):
        return [value.to(DEVICE) if isinstance(value, Tensor) else value for value in values]

    return bring
